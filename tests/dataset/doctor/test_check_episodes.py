import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from damaged import DATA, EPISODES, alter, drop
from fake_dataset import LENGTHS, concatenated, fake_episodes, write_fake

from astra_data.dataset.contents import measure
from astra_data.dataset.doctor.check import EXACT, EpisodeChecks, Report, is_close
from astra_data.dataset.integrity import Digests
from astra_data.dataset.plain import plain_columns
from astra_data.dataset.reader import Dataset


def checked(root: Path, is_ours: bool = True, digests: Digests | None = None) -> tuple[EpisodeChecks, Report]:
    info = json.loads((root / "meta/info.json").read_text())
    report = Report()
    checks = EpisodeChecks(root, info, plain_columns(info["features"])[0], digests or {}, is_ours, report)
    checks.run()
    checks.totals()
    return checks, report


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_fake(tmp_path / "set").root


def test_a_whole_dataset_is_counted_and_hashed(root: Path) -> None:
    checks, report = checked(root)
    assert (report.faults, report.notes) == ([], [])
    assert (report.episodes, report.frames) == (5, 55)
    assert checks.uids == [episode.uid for episode in fake_episodes()]
    assert checks.lengths == list(LENGTHS)
    assert checks.hash.hexdigest() == Dataset.open(root).content_hash


def test_statistics_of_ours_are_compared_exactly_and_others_loosely(root: Path) -> None:
    found = json.loads((root / "meta/stats.json").read_text())["mode"]["max"][0]
    number = next(
        number for number, episode in enumerate(fake_episodes()) if episode.columns["mode"].max() == found
    )
    alter(EPISODES, "stats/mode/max", number, [found * (1 + 1e-4)])(root)
    _, report = checked(root)
    assert len(report.faults) == 1
    assert f"max of mode in episode {number} is" in report.faults[0]
    _, report = checked(root, is_ours=False)
    assert (report.faults, report.notes) == ([], [])
    alter(EPISODES, "stats/mode/max", number, [found * 1.01])(root)
    alter(EPISODES, "stats/mode/std", number, [1.0])(root)
    alter(EPISODES, "stats/mode/count", number, [3])(root)
    alter(EPISODES, "stats/mode/q50", number, [1.0])(root)  # an estimate of lerobot's: not compared
    _, report = checked(root, is_ours=False)
    assert report.faults == []
    assert any(f"q50 of mode in episode {number} is [1.0]" in fault for fault in checked(root)[1].faults)
    what = f"of mode in episode {number} is"
    assert [f"statistics: {kind} {what}" for kind in ("max", "std", "count")] == [
        note[: note.index(" is ") + 3] for note in report.notes
    ]


@pytest.mark.parametrize(
    ("name", "kind", "change"),
    [
        ("action", "min", -0.5),
        ("action", "mean", 0.01),
        ("action", "std", 0.01),
        ("observation.state", "mean", 0.1),
        ("mode", "count", 1),
    ],
)
def test_the_statistics_of_a_plain_dataset_are_compared(
    root: Path, name: str, kind: str, change: float
) -> None:
    path = root / "meta/stats.json"
    stats = json.loads(path.read_text())
    assert checked(root, is_ours=False)[1].notes == []
    stats[name][kind][-1] += change
    path.write_text(json.dumps(stats))
    assert checked(root)[1].notes == []
    [note] = checked(root, is_ours=False)[1].notes
    assert note.startswith(f"statistics: {kind} of {name} is ")


def test_rounding_of_float32_is_not_told_of_a_plain_dataset(root: Path) -> None:
    """LeRobot sums values and squares in float32, which loses a small spread far from zero."""
    path = root / "meta/stats.json"
    stats = json.loads(path.read_text())
    state = concatenated("observation.state")
    with np.errstate(invalid="ignore"):
        square = np.mean(state**2, axis=0) - np.mean(state, axis=0) ** 2
    stats["observation.state"]["std"] = np.sqrt(np.maximum(0, square)).tolist()
    stats["observation.state"]["mean"] = np.mean(state, axis=0).tolist()
    path.write_text(json.dumps(stats))
    assert checked(root, is_ours=False)[1].notes == []


def test_rows_and_episodes_without_each_other_are_found(root: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(root, other)
    shutil.copy(root / DATA, other / "data/chunk-000/file-001.parquet")
    _, report = checked(other)
    assert "meta/episodes lacks episode 5" in report.faults
    assert "total_episodes is 5, expected 10" in report.faults
    assert "episodes 0 and 5 have the same uid 13" in report.faults
    drop(DATA)(root)
    _, report = checked(root)
    assert "meta/episodes has episode 4, the data has not" in report.faults


@pytest.mark.parametrize(
    ("stored", "expected", "tolerance", "close"),
    [
        ([1.0, 2.0], [1.0, 2.0], EXACT, True),
        ([1.0, 2.0 + 1e-7], [1.0, 2.0], EXACT, True),
        ([1.0, 2.0 + 1e-4], [1.0, 2.0], EXACT, False),
        # Relative to the largest: a small value beside a large one is known less well.
        ([1e-5, 100.0], [0.0, 100.0], EXACT, True),
        ([1e-3, 100.0], [0.0, 100.0], EXACT, False),
        ([[1.0], [2.0]], [1.0, 2.0], EXACT, True),
        ([1.0], [1.0, 1.0], EXACT, False),
        ([1.0, 2.0, 3.0], [1.0, 2.0], EXACT, False),
        (None, [1.0], EXACT, False),
        (["x"], [1.0], EXACT, False),
        ([10**400], [1.0], EXACT, False),
        ([float("nan")], [1.0], EXACT, False),
        ([1.0, 3.0], [1.0, float("nan")], EXACT, False),
        ([5.0, float("inf")], [1.0, float("inf")], EXACT, False),
    ],
)
def test_statistics_are_close(stored: object, expected: list[float], tolerance: float, close: bool) -> None:
    assert is_close(stored, np.array(expected), tolerance) is close


def test_values_are_compared_with_digests(root: Path) -> None:
    _, digests = measure(Dataset.open(root))
    assert checked(root, digests=digests)[1].faults == []
    alter(DATA, "mode", 20, 3)(root)
    _, report = checked(root, digests={"mode": digests["mode"]})
    assert f"mode: other values than were written in {DATA} rows 20 to 49 (episode 3)" in report.faults
    _, report = checked(root, digests={"action": digests["action"]})
    assert not [fault for fault in report.faults if "other values" in fault]
