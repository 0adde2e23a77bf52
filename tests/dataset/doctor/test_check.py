import hashlib
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from damaged import DATA, EPISODES, alter, declare, drop, edit, retype, truncate, write
from fake_dataset import COLUMNS, concatenated, fake_columns, fake_episodes, write_fake, writer

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset import Dataset
from astra_data.dataset.columns import Column, Episode
from astra_data.dataset.doctor.check import MOST, Report, check, compare_with_lerobot
from astra_data.dataset.format import POLICY_PATH


def drop_last_row(name: str) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        table = pq.read_table(root / name)
        pq.write_table(table.slice(0, len(table) - 1), root / name)

    return damage


def test_a_whole_dataset_has_no_faults(fake: Dataset) -> None:
    report = check(fake.root)
    assert (report.faults, report.notes) == ([], []) and (report.episodes, report.frames) == (5, 55)


def test_a_copy_without_its_description_is_not_whole(root: Path) -> None:
    """A dataset of LeRobot's has no folder of ours, and is."""
    (root / "meta/astra/dataset.json").unlink()
    assert [str(fault) for fault in check(root).faults] == [
        "meta/astra/dataset.json is missing: the dataset is incomplete; copy it again"
    ]
    shutil.rmtree(root / "meta/astra")
    assert check(root).faults == []


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (alter(DATA, "frame_index", 9, 7), ["frame_index is 7 in episode 2 frame 1, expected 1"]),
        (alter(DATA, "episode_index", 30, 9), ["episode_index is 9 in episode 3 frame 10, expected 3"]),
        (alter(DATA, "timestamp", 10, 0.2), ["timestamp is 0.2", "in episode 2 frame 2, expected 0.1"]),
        (alter(DATA, "task_index", 8, 3), ["episode 2 has the unknown tasks [3]"]),
        (
            alter(DATA, "observation.state", 10, [0, np.nan, 0]),
            ["observation.state is nan in episode 2 frame 2 index 1, expected a finite number"],
        ),
        (alter(DATA, "action", 10, [0, 0]), ["action: other values than were written in"]),
        (alter(EPISODES, "length", 1, 2), ["length of episode 1 is 2, expected 1"]),
        (alter(EPISODES, "dataset_from_index", 1, 9), ["dataset_from_index of episode 1 is 9, expected 7"]),
        (
            alter(EPISODES, "data/file_index", 1, 4),
            ["the file of episode 1 is 'data/chunk-000/file-004.parquet', expected 'data/chunk"],
        ),
        (drop_last_row(DATA), ["total_frames is 55, expected 54"]),
        (retype(EPISODES, "tasks", 7), ["tasks of episode 0 is 7, expected {'run'}"]),
        (alter(EPISODES, "stats/mode/max", 2, [5.0]), [f"{EPISODES} was altered"]),
        (write("meta/stats.json", b"{}"), ["meta/stats.json was altered"]),
        (drop("meta/tasks.parquet"), ["meta/tasks.parquet is missing"]),
        (drop(DATA), ["data has no parquet file"]),
        (truncate(DATA), ["file-000.parquet is truncated or no parquet file"]),
        (truncate("meta/info.json"), ["meta/info.json is no JSON object"]),
        (write("data/chunk-000/left.tmp", b""), ["data/chunk-000/left.tmp does not belong to it"]),
        (edit("meta/astra/subsets.json", uids=[13, 4]), ["meta/astra/subsets.json was altered"]),
        (edit("meta/astra/dataset.json", content_hash="0"), ["meta/astra/dataset.json was altered"]),
        (
            edit("meta/info.json", total_frames=1, total_episodes=2, total_tasks=3, codebase_version="v2.1"),
            ["is v2.1, expected v3.0", "total_frames is 1, expected 55", "total_episodes is 2", "total_tasks is 3"],
        ),
        (edit("meta/info.json", features={"action": None}), ["action is None in features, expected an object"]),
        (alter(DATA, "action", 9, None), ["action: expected 2 values in every row, some are missing"]),
        (edit("meta/info.json", data_path="../file.parquet"), ["expected a path inside the folder"]),
        (edit("meta/info.json", fps="20"), ["fps is '20', expected a positive number"]),
        (edit("meta/info.json", fps=2**31), ["expected a positive number below 2^31"]),
        (declare("action", names=["x"]), ["action: 1 names for 2 values"]),
        (declare("action", shape=["2"]), ["action has the shape ['2'], expected whole numbers"]),
        (declare("action", shape=2), ["action has the shape 2, expected whole numbers"]),
    ],
)
def test_damage_is_found(root: Path, damage: Callable[[Path], object], parts: list[str]) -> None:
    damage(root)
    faults = "\n".join(check(root).faults)
    for part in parts:
        assert part in faults


@pytest.mark.parametrize(
    ("damage", "faults"),
    [
        (
            alter(DATA, "next.reward", 25, 9.0),
            f"next.reward: other values than were written in {DATA} rows 20 to 49 (episode 3)",
        ),
        (
            alter("meta/astra/episodes.parquet", "success", 1, True),
            "meta/astra/episodes.parquet was altered after it was written, or is missing",
        ),
        (
            alter("meta/astra/digests.parquet", "action", 1, 5),
            "meta/astra/digests.parquet was altered after it was written, or is missing",
        ),
    ],
)
def test_what_was_altered_is_named(root: Path, damage: Callable[[Path], object], faults: str) -> None:
    damage(root)
    assert faults in check(root).faults
    # Nothing else is named so.
    assert sum("other values" in fault or "was altered" in fault for fault in check(root).faults) == 1


def test_the_policy_that_acted_is_compared_with_what_was_recorded_of_it(tmp_path: Path) -> None:
    root, acted = tmp_path / "set", tmp_path / "policy"
    acted.write_bytes(b"weights")
    expected = hashlib.sha256(b"weights").hexdigest()
    with writer(root) as open_writer:
        open_writer.add(Episode(0, fake_columns(3, seed=0)))
        open_writer.policy, open_writer.made = acted, {"behavior": {"policy_sha256": expected}}
    assert check(root).faults == []
    for damage, found in (
        (write(POLICY_PATH, b"others"), hashlib.sha256(b"others").hexdigest()),
        (drop(POLICY_PATH), "not there"),
    ):
        damage(root)
        assert f"{POLICY_PATH} is {found}, expected the sha256 {expected}" in check(root).faults


def test_all_faults_are_told_but_few_of_a_kind(tmp_path: Path) -> None:
    root = write_fake(tmp_path / "set", (Episode(uid, fake_columns(3, seed=uid)) for uid in range(12))).root
    table = pq.read_table(root / DATA)
    for name in ("timestamp", "frame_index"):
        at, field = table.column_names.index(name), table.schema.field(name)
        doubled = [2 * value for value in table.column(name).to_pylist()]
        table = table.set_column(at, field, pa.array(doubled, field.type))
    pq.write_table(table, root / DATA)
    report = check(root)
    assert sum(fault.startswith("frame_index is 2 in episode") for fault in report.faults) == MOST
    for name in ("frame_index", "timestamp"):
        assert f"{name}: and 7 more of this kind" in report.faults
    assert report.fault_count == 36


def test_columns_that_differ_from_the_declared_are_told(root: Path) -> None:
    table = pq.read_table(root / DATA)
    table = table.drop_columns(["action"]).append_column("extra", table.column("mode"))
    at = table.column_names.index("next.reward")
    pq.write_table(table.set_column(at, "next.reward", table.column("mode")), root / DATA)
    faults = "\n".join(check(root).faults)
    for part in ("lacks column action", "unknown column extra", "has next.reward as int64, expected float"):
        assert part in faults


@pytest.mark.usefixtures("scattered")
def test_a_missing_file_is_named_alone(root: Path) -> None:
    name = DATA.replace("file-000", "file-002")
    drop(name)(root)
    assert check(root).faults == [f"{name} is missing"]
    shutil.rmtree(root / "meta/astra")
    assert check(root).faults == [f"{name} is missing"]
    with pytest.raises(CorruptDatasetError, match=f"{name} missing"):
        Dataset.open(root)


def test_a_plain_dataset_is_checked_without_our_metadata(root: Path) -> None:
    for path in (root / "meta/astra").iterdir():
        path.unlink()
    (root / "meta/other.json").write_text("{}")
    report = check(root)
    assert report.faults == [] and "a plain LeRobot dataset" in report.notes[0]
    assert "meta/other.json does not belong to it" in report.notes
    alter(DATA, "next.done", 9, True)(root)
    report = check(root)
    assert not [fault for fault in report.faults if "next.done" in fault]
    assert "next.done is True in episode 2 frame 1, before the last frame 11" in report.notes
    alter(DATA, "index", 8, 70)(root)
    assert "index is 70 in episode 2 frame 0, expected 8" in check(root).faults


@pytest.fixture
def plain(root: Path) -> Path:
    """A dataset without our metadata."""
    shutil.rmtree(root / "meta/astra")
    return root


def test_what_is_no_number_is_no_column_of_a_plain_dataset(plain: Path) -> None:
    declare("next.reward", dtype=None)(plain)
    declare("action", shape=[2, 1])(plain)
    report = check(plain)
    assert report.faults == [] and "not checked, because they are not numeric: action, next.reward" in report.notes


def told(root: Path) -> list[str]:
    """What is told of the statistics of a dataset without faults."""
    report = check(root)
    assert report.faults == []
    return [note for note in report.notes if note.startswith("statistics: ")]


def test_the_statistics_of_episodes_are_compared_as_estimates(plain: Path) -> None:
    found = json.loads((plain / "meta/stats.json").read_text())["mode"]["max"][0]
    number = next(number for number, episode in enumerate(fake_episodes()) if episode.columns["mode"].max() == found)
    alter(EPISODES, "stats/mode/max", number, [found * (1 + 1e-4)])(plain)
    alter(EPISODES, "stats/mode/q50", number, [1.0])(plain)  # an estimate of lerobot's: not compared
    assert told(plain) == []
    alter(EPISODES, "stats/mode/max", number, [found * 1.01])(plain)
    alter(EPISODES, "stats/mode/std", number, [1.0])(plain)
    alter(EPISODES, "stats/mode/count", number, [3])(plain)
    what = f"of mode in episode {number} is"
    notes = [note[: note.index(" is ") + 3] for note in told(plain)]
    assert notes == [f"statistics: {kind} {what}" for kind in ("max", "std", "count")]


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
def test_the_statistics_of_a_plain_dataset_are_compared(plain: Path, name: str, kind: str, change: float) -> None:
    path = plain / "meta/stats.json"
    stats = json.loads(path.read_text())
    assert told(plain) == []
    stats[name][kind][-1] += change
    path.write_text(json.dumps(stats))
    [note] = told(plain)
    assert note.startswith(f"statistics: {kind} of {name} is ")


def test_rounding_of_float32_is_not_told_of_a_plain_dataset(plain: Path) -> None:
    """LeRobot sums values and squares in float32, which loses a small spread far from zero."""
    path = plain / "meta/stats.json"
    stats = json.loads(path.read_text())
    state = concatenated("observation.state")
    with np.errstate(invalid="ignore"):
        square = np.mean(state**2, axis=0) - np.mean(state, axis=0) ** 2
    stats["observation.state"]["std"] = np.sqrt(np.maximum(0, square)).tolist()
    stats["observation.state"]["mean"] = np.mean(state, axis=0).tolist()
    path.write_text(json.dumps(stats))
    assert told(plain) == []


def test_rows_and_episodes_without_each_other_are_found(plain: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(plain, other)
    shutil.copy(plain / DATA, other / "data/chunk-000/file-001.parquet")
    faults = check(other).faults
    assert "meta/episodes lacks episode 5" in faults and "total_episodes is 5, expected 10" in faults
    assert "episodes 0 and 5 have the same uid 13" in faults
    table = pq.read_table(plain / DATA)
    pq.write_table(table.slice(0, 50), plain / DATA)
    edit("meta/info.json", total_frames=50)(plain)
    assert "meta/episodes has episode 4, the data has not" in check(plain).faults


LEROBOT = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


def compared(root: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")  # set by the function, and restored here
    report = Report(5, 55)
    compare_with_lerobot(root, report)
    return report.faults


@LEROBOT
def test_lerobot_reads_the_same_windows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import datasets.config  # noqa: PLC0415 - slow

    usual = datasets.config.HF_DATASETS_CACHE
    with writer(tmp_path / "set", columns=[*COLUMNS, Column("observation.count", "int64")]) as out:
        for one in fake_episodes():
            counted = {**one.columns, "observation.count": one.columns["mode"]}
            out.add(Episode(one.uid, counted, one.metadata))
    assert compared(tmp_path / "set", monkeypatch) == [] and usual == datasets.config.HF_DATASETS_CACHE


@LEROBOT
def test_what_lerobot_reads_otherwise_or_not_at_all_is_a_fault(plain: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # lerobot takes boundaries from meta/episodes: the last ends a step off.
    alter(EPISODES, "dataset_to_index", 4, 54)(plain)
    faults = compared(plain, monkeypatch)
    for name in ("observation.state", "action"):
        for other in ("values", "padding"):
            assert f"lerobot's window of {name} around row 54 has other {other}" in faults
    drop("meta/tasks.parquet")(plain)
    [fault] = compared(plain, monkeypatch)
    assert fault.startswith("lerobot cannot open it: ")


def test_without_lerobot_the_extra_is_named(plain: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lerobot", None)
    with pytest.raises(BadInputError, match=r"lerobot is needed but not installed: uv sync --extra lerobot"):
        compared(plain, monkeypatch)
