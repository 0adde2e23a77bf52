"""One fault in otherwise good logs is one finding, and it names the fault."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from toy_logs import CLOCK, COLUMNS, FPS, Columns, toy_columns, write_logs

from astra_data.dataset import Dataset, DatasetWriter
from astra_data.dataset.checkup.checkup import Checkup, check_up
from astra_data.dataset.checkup.finding import Finding
from astra_data.dataset.columns import ACTION, NEXT_STATE, STATE, Episode


def test_good_logs_have_no_findings(tmp_path: Path) -> None:
    checkup = check_up(write_logs(tmp_path / "logs"))
    assert checkup == Checkup(
        "logs@data-1.0.0",
        (
            "endings: 30 after 100 steps, the longest (a time limit)",
            "commands: held 0.5 s (median), 0.5 s (95 %); steps at the edge of the range: v 0.7 %, w 0.7 %",
            "rate: 20 Hz declared, 20 Hz by time; gaps within episodes: 0, jitter 0.0 % of a period",
        ),
        (),
    )


def carried(uid: int, columns: Columns) -> None:
    if uid == 7:
        columns[STATE][50:, 0] += 1.0
        columns[NEXT_STATE][49:, 0] += 1.0


def missed(uid: int, columns: Columns) -> None:
    if uid in (3, 4):
        columns["time"][50:] += 10**8


def slow(uid: int, columns: Columns) -> None:
    columns["time"] = columns["time"] * 2


def jittery(uid: int, columns: Columns) -> None:
    columns["time"][1::2] += 12 * 10**6


def standing(uid: int, columns: Columns) -> None:
    if uid == 9:
        columns["time"][50:] -= 10**9 // 20


def dead(uid: int, columns: Columns) -> None:
    for name in (STATE, NEXT_STATE):
        columns[name][:, 1] = 0.5


def stuck(uid: int, columns: Columns) -> None:
    if uid == 5:
        columns[STATE][30:, 2] = columns[NEXT_STATE][29:, 2] = columns[STATE][30, 2]


def unused(uid: int, columns: Columns) -> None:
    columns[ACTION][:, 1] = 0.0


def copied(uid: int, columns: Columns) -> Columns | None:
    return toy_columns(2) if uid in (11, 12) else None


def short(uid: int, columns: Columns) -> Columns | None:
    return toy_columns(uid, 12) if uid == 6 else None


def torn(uid: int, columns: Columns) -> None:
    if uid == 2:
        columns[NEXT_STATE][60, 0] += 0.001


def rewarded(uid: int, columns: Columns) -> None:
    if uid == 8:
        columns["next.reward"] += 5.0


def far(uid: int, columns: Columns) -> None:
    if uid == 1:
        for name in (STATE, NEXT_STATE):
            columns[name][:, 1] -= 40.0


def saturated(uid: int, columns: Columns) -> None:
    columns[ACTION][:, 1] = np.clip(2 * columns[ACTION][:, 1], -1, 1)


def in_degrees(uid: int, columns: Columns) -> None:
    for name in (STATE, NEXT_STATE):
        columns[name][:, 2] *= np.float32(180 / np.pi)


def failing(uid: int, columns: Columns) -> None:
    if uid < 9:
        columns["next.terminated"] = columns["next.done"]
        columns["next.truncated"] = columns["next.truncated"] & False


FAULTS: list[tuple[Callable[[int, Columns], Columns | None], str, tuple[int, ...], str, str]] = [
    (
        carried,
        "warning",
        (7,),
        "1 single-step jump in x of observation.state; the largest is 1",
        "[split.jump]",
    ),
    (missed, "warning", (3, 4), "steps of over 1.5 periods: 2, the longest 0.15 s", "gap_s = 0.075"),
    (slow, "warning", (), "time runs at 10 Hz, but 20 Hz is declared", "correct `fps`"),
    (jittery, "note", (), "5 % of the steps are off by 24 %", "resample the recording to 20 Hz"),
    (standing, "warning", (9,), "time stands still or goes back", "delete walks --episode 9"),
    (dead, "note", (), "constant in all steps: y of observation.state", "check the log"),
    (stuck, "warning", (5,), "others move: yaw of observation.state", "delete walks --episode 5"),
    (unused, "note", (), "constant in all steps: w of action", "its effect cannot be learned"),
    (copied, "warning", (11, 12), "11 has the states and actions of 2", "--episode 11 --episode 12"),
    (short, "note", (6,), "6 by length 12 steps, median 100", "delete walks --episode 6"),
    (torn, "warning", (2,), "not the state of the next row: 1 of 2970", "rows are missing"),
    (rewarded, "note", (8,), "8 by return 59", "delete walks --episode 8"),
    (far, "note", (1,), "1 by y of observation.state, which reaches -4", "delete walks --episode 1"),
    (in_degrees, "warning", (), "yaw of observation.state: up to", "degrees, set `scale` to 0.0174533"),
    (saturated, "note", (), "at the edge of their range in up to", "record gentler commands"),
    (failing, "note", tuple(range(9)), "9 failures, which is little", "--behavior stress"),
]


@pytest.mark.parametrize("case", FAULTS, ids=lambda case: case[0].__name__)
def test_a_planted_fault_is_the_one_finding(
    tmp_path: Path,
    case: tuple[Callable[[int, Columns], Columns | None], str, tuple[int, ...], str, str],
) -> None:
    alter, severity, episodes, what, advice = case
    found = check_up(write_logs(tmp_path / "logs", alter), "walks").findings
    assert len(found) == 1, found
    assert (found[0].severity, found[0].episodes) == (severity, episodes)
    assert what in found[0].what
    assert advice in found[0].advice


def test_warnings_come_first_and_findings_are_recorded(tmp_path: Path) -> None:
    def both(uid: int, columns: Columns) -> Columns | None:
        rewarded(uid, columns)
        return copied(uid, columns)

    checkup = check_up(write_logs(tmp_path / "logs", both))
    assert [finding.severity for finding in checkup.findings] == ["warning", "note"]
    record = checkup.record()
    assert record["dataset"] == "logs@data-1.0.0"
    assert record["findings"][0]["episodes"] == [11, 12]
    assert "logs@data-1.0.0 --episode 11" in record["findings"][0]["advice"]
    assert set(record["findings"][1]) == set(Finding.__dataclass_fields__)


@pytest.mark.parametrize(
    ("sources", "format_", "is_mcap"),
    [
        (["a.mcap", "b.MCAP"], None, True),
        (["a.csv", "b.csv"], None, False),
        (["a.csv", "b.mcap"], None, None),
        (["a.mcap"], None, None),
        ([], None, None),
        (["a", "b"], "mcap", True),
    ],
)
def test_whether_a_dataset_is_of_mcap_is_seen_by_its_files(
    tmp_path: Path, sources: list[str], format_: str | None, is_mcap: bool | None
) -> None:
    """Also where it is a part of one; two episodes, of which some tell no file."""
    description = {"name": "logs", "stage": "import", "config": {"format": format_} if format_ else {}}
    with DatasetWriter(
        tmp_path / "logs", [*COLUMNS, CLOCK], fps=FPS, task="drive", description=description
    ) as writer:
        for uid in range(2):
            columns = toy_columns(uid)
            missed(3, columns)
            writer.add(Episode(uid, columns, {"source": sources[uid]} if uid < len(sources) else {}))
    findings = check_up(Dataset.open(tmp_path / "logs"), "walks").findings
    (advice,) = [finding.advice for finding in findings if "steps of over" in finding.what]
    assert ("`time`" in advice) is (is_mcap is not True)
    assert ("[columns." in advice) is (is_mcap is not False)
