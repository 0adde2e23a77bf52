import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import killed_lerobot
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from damaged import DATA, EPISODES, alter, alter_rows, drop, edit, reseal, truncate, write
from fake_dataset import COLUMNS, DESCRIPTION, LENGTHS, assert_same, fake_columns, fake_episodes, write_fake

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset import Dataset
from astra_data.dataset.columns import DONE, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED, Array, Episode
from astra_data.dataset.doctor.check import check
from astra_data.dataset.doctor.repair import Remains, join, remains_of, repair
from astra_data.dataset.format import DATASET_PATH, DIGESTS_PATH, INFO_PATH, METADATA_PATH, SUBSETS_PATH
from astra_data.dataset.lerobot_recording import RECORDED_TASK


@pytest.fixture
def killed(recorded: Path) -> Path:
    """The folders that `killed_lerobot` leaves behind."""
    return recorded / "killed"


@pytest.fixture
def whole(tmp_path: Path) -> Dataset:
    """A fake dataset whose subsets are of a seed of their own."""
    return write_fake(tmp_path / "set", subset_seed=7)


def assert_saved(root: Path, episodes: int) -> None:
    saved = Dataset.open(root)
    assert saved.verify() == [] and check(root).faults == [] and saved.uids.tolist() == list(range(episodes))
    for number, episode in enumerate(saved.episodes()):
        assert episode.metadata["task"] == killed_lerobot.task(number)
        recorded = killed_lerobot.values(number)
        last = np.arange(len(episode)) == len(episode) - 1
        expected = {name: values[:-1] for name, values in recorded.items()} | {
            NEXT_STATE: recorded[STATE][1:],
            TERMINATED: np.zeros(len(episode), bool),
            TRUNCATED: last,
            DONE: last,
            RECORDED_TASK: np.full(len(episode), number % 2),
        }
        assert len(episode) == killed_lerobot.length(number) - 1 and episode.columns.keys() == expected.keys()
        for name, values in expected.items():
            kept = values.astype(np.float32) if values.dtype == np.float64 else values
            np.testing.assert_array_equal(episode.columns[name], kept)


@pytest.mark.parametrize(
    ("case", "episodes", "faults"),
    [
        ("whole", 8, []),
        ("saved", 25, [f"{DATA} is truncated", f"{EPISODES} is truncated"]),
        ("buffered", 3, [f"{DATA} is truncated", "meta/episodes has no parquet file"]),
        ("resumed", 8, ["data/chunk-000/file-001.parquet is truncated"]),
    ],
)
def test_every_saved_episode_of_a_killed_writer_is_recovered(
    killed: Path, tmp_path: Path, case: str, episodes: int, faults: list[str]
) -> None:
    found = "\n".join(check(killed / case).faults)
    assert all(fault in found for fault in faults) and bool(found) == bool(faults)
    before = {path: path.read_bytes() for path in (killed / case).rglob("*") if path.is_file()}
    repaired = repair(killed / case, out=tmp_path / "saved")
    frames = sum(map(killed_lerobot.length, range(episodes))) - episodes  # the last have no next state
    assert (repaired.episodes, repaired.frames) == (episodes, frames)
    assert "force was float64 and is now float32" in repaired.notes
    assert not [note for note in repaired.notes if "lost" in note]
    assert_saved(tmp_path / "saved", episodes)
    assert before == {path: path.read_bytes() for path in (killed / case).rglob("*") if path.is_file()}


@pytest.mark.parametrize("share", [0.05, 0.62])
def test_of_a_file_that_was_cut_the_whole_row_groups_are_recovered(killed: Path, tmp_path: Path, share: float) -> None:
    root = shutil.copytree(killed / "saved", tmp_path / "cut")
    os.truncate(root / DATA, int((root / DATA).stat().st_size * share))
    try:
        repaired = repair(root, out=tmp_path / "saved")
    except CorruptDatasetError as error:
        assert share == 0.05 and "no whole row group" in str(error)
        return
    assert abs(repaired.episodes - 25 * share) < 3
    assert f"{25 - repaired.episodes} of the 25 episodes that meta/info.json counts are lost" in repaired.notes
    assert_saved(tmp_path / "saved", repaired.episodes)


def test_episodes_with_wrong_values_are_left_out(root: Path, tmp_path: Path) -> None:
    alter_rows(root / DATA, "next.reward", {25: float("nan")})
    alter_rows(root / DATA, "next.done", {3: True})
    (root / EPISODES).unlink()
    (root / "meta/stats.json").unlink()
    repaired = repair(root, out=tmp_path / "saved")
    assert repaired.episodes == 3
    notes = "\n".join(repaired.notes)
    assert "meta/episodes was missing" in notes
    assert "left out episode 0: next.done is True in episode 0 frame 3, before the last frame 6" in notes
    assert "left out episode 3: next.reward is nan in episode 3 frame 5" in notes and "2 of the 5 episodes" in notes
    saved = Dataset.open(tmp_path / "saved")
    assert (saved.reference, saved.description["stage"]) == ("fake@data-1.1.0", "repair")
    assert saved.verify() == [] and check(saved.root).faults == []
    whole = [episode for number, episode in enumerate(fake_episodes()) if number not in (0, 3)]
    assert_same(saved.episodes(), whole)


def test_only_the_first_episode_of_a_uid_is_saved(root: Path, tmp_path: Path) -> None:
    drop(DIGESTS_PATH)(root)
    alter_rows(root / DATA, "episode_uid", dict.fromkeys(range(8, 20), 4))
    repaired = repair(root, out=tmp_path / "saved")
    assert "left out episode 2: its uid 4 is taken or negative" in repaired.notes
    assert Dataset.open(tmp_path / "saved").uids.tolist() == [13, 4, 6, 0]
    repair(root, out=tmp_path / "all", new_uids=True)
    every = Dataset.open(tmp_path / "all")
    assert every.lengths.tolist() == list(LENGTHS) and every.metadata["merged_uid"] == [None, None, 4, None, None]
    alter_rows(root / DATA, REWARD, {7: float("nan")})  # the first is lost: the second may have its uid
    repair(root, out=tmp_path / "others")
    others = Dataset.open(tmp_path / "others")
    assert (others.uids.tolist(), others.lengths.tolist()) == ([13, 4, 6, 0], [7, 12, 30, 5])


def as_format_2(root: Path, episodes: int = 4) -> Path:
    """Write what LeRobot recorded in format 2.1: a file for each episode, tasks in JSON Lines."""
    (root / "data/chunk-000").mkdir(parents=True)
    (root / "meta").mkdir()
    rng, row, rows = np.random.default_rng(0), 0, []
    vector = {"dtype": "float32", "shape": [3], "names": [["hip", "knee", "foot"]]}
    single = {"dtype": "int64", "shape": [1], "names": None}
    for number in range(episodes):
        length = 5 + number
        state = rng.normal(size=(length, 3)).astype(np.float32)
        columns = {
            "observation.state": pa.array(list(state), pa.list_(pa.float32(), 3)),
            "action": pa.array(list(state + 1), pa.list_(pa.float32(), 3)),
            "timestamp": pa.array(np.arange(length) / 10, pa.float32()),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, number),
            "index": np.arange(row, row + length),
            "task_index": np.zeros(length, np.int64),
        }
        pq.write_table(pa.table(columns), root / f"data/chunk-000/episode_{number:06d}.parquet")
        rows.append({"episode_index": number, "tasks": ["open the door"], "length": length})
        row += length
    features: dict[str, object] = {name: single for name in columns}
    features |= {STATE: vector, "action": vector, "timestamp": single | {"dtype": "float32"}}
    path = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    info = {"codebase_version": "v2.1", "fps": 10, "features": features, "data_path": path}
    info |= {"total_episodes": episodes, "total_frames": row, "total_tasks": 1, "chunks_size": 1000}
    (root / "meta/info.json").write_text(json.dumps(info))
    (root / "meta/episodes.jsonl").write_text("\n".join(map(json.dumps, rows)))
    (root / "meta/tasks.jsonl").write_text('{"task_index": 0, "task": "open the door"}\n')
    return root


@pytest.mark.parametrize("lost", [None, 2])
def test_format_2_is_converted_with_tasks_and_names(tmp_path: Path, lost: int | None) -> None:
    root = as_format_2(tmp_path / "old")
    with pytest.raises(BadInputError, match=r"has LeRobot's format v2\.1, expected v3\.0: convert it with"):
        Dataset.open(root)
    [fault] = check(root).faults
    assert fault.endswith(f"or astra-data repair {root} --out DIR")
    names = [f"data/chunk-000/episode_{number:06d}.parquet" for number in range(4)]
    states = [pq.read_table(root / name).column(STATE).to_pylist() for name in names]
    if lost is not None:
        (root / names[lost]).unlink()
    notes = repair(root, out=tmp_path / "new").notes
    found = Dataset.open(tmp_path / "new")
    assert (found.task, found.info["fps"]) == ("open the door", 10)
    assert found.features[STATE]["names"] == ["hip", "knee", "foot"]
    whole = [states[number][:-1] for number in range(4) if number != lost]
    assert [episode.columns[STATE].tolist() for episode in found.episodes()] == whole
    assert notes[0] == "LeRobot's format v2.1 became v3.0"
    gone = [] if lost is None else [f"{names[lost]} is missing"]
    assert [note for note in notes if note.endswith("is missing")] == gone


def test_tasks_are_known_by_their_index(killed: Path, tmp_path: Path) -> None:
    root = shutil.copytree(killed / "whole", tmp_path / "set")
    indices = pq.read_table(root / DATA).column("task_index").to_pylist()
    alter_rows(root / DATA, "task_index", {row: index + 1 for row, index in enumerate(indices)})
    pq.write_table(pa.table({"task_index": [1, 2], "task": ["walk", "run"]}), root / TASKS)
    (root / EPISODES).unlink()
    notes = repair(root, out=tmp_path / "saved").notes
    saved = Dataset.open(tmp_path / "saved")
    assert saved.description["repaired"] == notes
    assert "the 2 tasks were merged into one; each episode's own is in its metadata 'task'" in notes
    assert saved.metadata["task"] == [killed_lerobot.task(number) for number in range(8)]
    assert saved.task == "walk / run"
    # Edited by LeRobot, all episodes of such a dataset have the task that names theirs, unless they were given another.
    edited = shutil.copytree(saved.root, tmp_path / "edited", ignore=shutil.ignore_patterns("astra"))
    pq.write_table(pa.table({"task_index": [0, 1], "task": [saved.task, "sit"]}), edited / TASKS)
    alter_rows(edited / DATA, "task_index", dict.fromkeys(range(saved.lengths[0]), 1))
    repair(edited, out=tmp_path / "joined", like=saved)
    assert Dataset.open(tmp_path / "joined").metadata["task"] == ["sit", *saved.metadata["task"][1:]]


def test_an_episode_that_may_have_been_cut_is_left_out(root: Path, tmp_path: Path) -> None:
    pq.write_table(pq.read_table(root / DATA), root / DATA, row_group_size=20)
    truncate(DATA)(root)
    drop(EPISODES)(root)
    repaired = repair(root, out=tmp_path / "saved")
    assert repaired.episodes == 4
    assert f"left out rows 50 to 54 of {DATA}: they may be part of an episode" in repaired.notes


def test_metadata_is_joined_by_uid(whole: Dataset, tmp_path: Path) -> None:
    edited = shutil.copytree(whole.root, tmp_path / "edited", ignore=shutil.ignore_patterns("astra"))
    repair(edited, out=tmp_path / "alone")
    assert Dataset.open(tmp_path / "alone").metadata == Dataset.open(edited).metadata  # of LeRobot: with next states
    alone, before = (Dataset.open(at).columns([NEXT_STATE])[NEXT_STATE] for at in (tmp_path / "alone", edited))
    np.testing.assert_array_equal(alone, before)
    repair(edited, out=tmp_path / "joined", like=whole)
    joined = Dataset.open(tmp_path / "joined")
    assert (joined.metadata, joined.order) == (whole.metadata, whole.order)
    assert joined.description["environment"] == {"id": "Fake-v0"}
    assert joined.description["parents"] == [whole.identity] and joined.reference == "fake@data-1.1.0"
    other = write_fake(tmp_path / "other", description={**DESCRIPTION, "name": "other"})
    repair(edited, out=tmp_path / "merged", like=[whole, other])
    assert Dataset.open(tmp_path / "merged").description["parents"] == [whole.identity, other.identity]


def test_lists_without_a_size_are_read_as_lerobots_merge_writes_them(tmp_path: Path) -> None:
    root = write_fake(tmp_path / "set", subset_seed=7).root
    table = pq.read_table(root / DATA)
    at = table.column_names.index("action")
    lists = table.column("action").to_pylist()
    pq.write_table(table.set_column(at, "action", pa.array(lists, pa.list_(pa.float32()))), root / DATA)
    shutil.rmtree(root / "meta/astra")
    assert check(root).faults == []
    repair(root, out=tmp_path / "saved", like=write_fake(tmp_path / "again"))
    assert Dataset.open(tmp_path / "saved").content_hash == Dataset.open(tmp_path / "again").content_hash
    lists[9] = [1.0, 2.0, 3.0]
    lists[10] = [1.0]
    pq.write_table(table.set_column(at, "action", pa.array(lists, pa.list_(pa.float32()))), root / DATA)
    assert check(root).faults == ["action: expected 2 values in every row"]


def test_what_cannot_be_repaired_is_told_and_nothing_is_written(root: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="exists already"):
        repair(root, out=root)
    (root / DATA).write_bytes(b"PAR1 rubbish" * 50)
    with pytest.raises(CorruptDatasetError, match=r"not one whole episode; .*no whole row group"):
        repair(root, out=tmp_path / "saved")
    (root / "meta/info.json").write_text('{"fps": 20, "features": {}}')
    with pytest.raises(CorruptDatasetError, match="lacks the columns episode_index, frame_index"):
        repair(root, out=tmp_path / "saved")
    (root / "meta/info.json").unlink()
    with pytest.raises(CorruptDatasetError, match=r"meta/info\.json is missing; without it"):
        repair(root, out=tmp_path / "saved")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_an_altered_value_is_told_though_it_cannot_be_found(root: Path, tmp_path: Path) -> None:
    edit(DATASET_PATH, content_hash="0" * 64)(root)
    reseal(root)
    drop(DIGESTS_PATH)(root)
    result = repair(root, out=tmp_path / "out")
    assert [note for note in result.notes if "a value was altered after it was written" in note]
    assert Dataset.open(tmp_path / "out").description["repaired"] == result.notes


def test_episodes_with_other_values_than_were_written_are_left_out(whole: Dataset, tmp_path: Path) -> None:
    alter_rows(whole.root / DATA, "next.reward", {25: 9.0})
    alter_rows(whole.root / DATA, "frame_index", {9: 7})  # a wrong structure costs no later episode either
    repaired = repair(whole.root, out=tmp_path / "saved")
    [second, third, lost] = repaired.notes
    assert "left out episode 2: frame_index is 7" in second
    other = "other values than were written in"
    assert third == f"left out episode 3: next.reward: {other} {DATA} rows 20 to 49 (episode 3)"
    assert lost == "2 of the 5 episodes that meta/info.json counts are lost"
    saved = Dataset.open(tmp_path / "saved")
    assert saved.description["repaired"] == repaired.notes
    kept = [episode for number, episode in enumerate(fake_episodes()) if number not in (2, 3)]
    assert_same(saved.episodes(), kept)


@pytest.mark.parametrize(
    ("name", "feature"),
    [
        ("mode", None),
        ("action", None),
        ("action", {"dtype": "float31", "shape": [2], "names": ["x", "y"]}),
        ("action", {"dtype": "float32", "shape": [3], "names": ["x", "y"]}),
        ("observation.state", {"dtype": "float32", "shape": [3], "names": None, "astra": {"unit": ["m"]}}),
        ("observation.state", {"dtype": "float32", "shape": [3], "names": None, "astra": "m"}),
    ],
)
def test_columns_are_what_is_stored_whatever_info_says(
    whole: Dataset, tmp_path: Path, name: str, feature: object
) -> None:
    features = json.loads((whole.root / INFO_PATH).read_text())["features"]
    changed = {key: one for key, one in (features | {name: feature}).items() if key != "mode" or name != "mode"}
    edit(INFO_PATH, features=changed)(whole.root)
    notes = repair(whole.root, out=tmp_path / "saved").notes
    assert name in notes[0] and INFO_PATH in notes[0] and "none" not in "".join(notes)
    saved = Dataset.open(tmp_path / "saved")
    assert saved.content_hash == whole.content_hash and saved.metadata == whole.metadata
    assert name != "action" or saved.features["action"]["names"] == (feature and ["x", "y"])


def test_episodes_with_other_values_than_the_original_are_left_out(fake: Dataset, tmp_path: Path) -> None:
    edited = shutil.copytree(fake.root, tmp_path / "edited", ignore=shutil.ignore_patterns("astra"))
    alter_rows(edited / DATA, REWARD, {0: 9.0})
    uid, *others = fake.uids.tolist()
    repaired = repair(edited, out=tmp_path / "joined", like=fake)
    assert f"left out the episode of uid {uid}: its values are not those in {fake.reference}" in repaired.notes
    joined = Dataset.open(tmp_path / "joined")
    assert joined.uids.tolist() == others
    assert joined.metadata == {key: values[1:] for key, values in fake.metadata.items()}
    # In a merge it may be another dataset's, whose uids were the same.
    repair(edited, out=tmp_path / "merged", like=fake, new_uids=True)
    merged = Dataset.open(tmp_path / "merged")
    assert merged.metadata == {key: [None, *values[1:]] for key, values in fake.metadata.items()}


def stored(*datasets: Dataset) -> list[tuple[int, dict[str, Array]]]:
    return [(episode.uid, dict(episode.columns)) for dataset in datasets for episode in dataset.episodes()]


@pytest.fixture
def other(tmp_path: Path) -> Dataset:
    """Two episodes; the first has a uid of the fake dataset, the second was made from it."""
    first = Episode(4, fake_columns(3, seed=50), {"floor": "carpet"})
    return write_fake(tmp_path / "other", [first, Episode(99, fake_columns(3, seed=51), {"source_episode": 4})])


def test_each_has_the_metadata_of_its_own_dataset(fake: Dataset, other: Dataset) -> None:
    joined = join(stored(other, fake), COLUMNS, [fake, other])
    # The fake dataset's episode 4 comes later, and is the one with a new uid.
    assert [episode.uid for episode in joined[:3]] == [4, 99, 13] and joined[0].metadata == {"floor": "carpet"}
    assert joined[1].metadata == {"source_episode": 4} and joined[3].uid not in (4, 99, *fake.uids.tolist())
    assert joined[3].metadata["merged_uid"] == 4 and all(episode.is_known for episode in joined)


def test_sources_of_copies_follow_their_new_uids(fake: Dataset, other: Dataset) -> None:
    joined = join(stored(fake, other), COLUMNS, [fake, other])
    assert joined[-1].metadata == {"source_episode": joined[-2].uid} and joined[-2].uid != 4


def test_the_same_episode_again_has_another_uid_the_same_in_every_run(fake: Dataset) -> None:
    first, again = (join(stored(fake, fake, fake), COLUMNS, [fake]) for _ in range(2))
    uids = [episode.uid for episode in first]
    assert len(set(uids)) == 3 * len(fake) and min(uids) >= 0 and max(uids) < 2**63
    assert uids == [episode.uid for episode in again]


INFO, TASKS = INFO_PATH, "meta/tasks.parquet"
SEED_0 = "the order of the subsets is that of seed 0"
WAS, COMPARED = "was altered after it was written", "the values were compared with the content hash only, as a whole"
LOST = "success, return and the like of the episodes are lost"


def seen(root: Path, *sources: Dataset) -> tuple[Remains, list[str]]:
    notes: list[str] = []
    return remains_of(root, sources, notes), notes


@pytest.mark.parametrize(
    ("damage", "note", "lost"),
    [
        (drop(SUBSETS_PATH), f"{SUBSETS_PATH} is missing: {SEED_0}", "subset_seed"),
        (write(SUBSETS_PATH, b"{"), f"{SUBSETS_PATH} {WAS}: {SEED_0}", "subset_seed"),
        (edit(SUBSETS_PATH, seed=8), f"{SUBSETS_PATH} {WAS}: {SEED_0}", "subset_seed"),
        (drop(METADATA_PATH), f"{METADATA_PATH} is missing: {LOST}", "metadata"),
        (alter(METADATA_PATH, "return", 0, 9.0), f"{METADATA_PATH} {WAS}: {LOST}", "metadata"),
        (drop(TASKS), f"{TASKS} is missing: the task is unknown", "tasks"),
        (alter(TASKS, "task", 0, "sit"), f"{TASKS} {WAS}: the task may be wrong", ""),
        (edit(INFO, fps=10), f"{INFO} {WAS}: names, units and fps may be wrong", ""),
        (drop(DIGESTS_PATH), f"{DIGESTS_PATH} is missing: {COMPARED}", "digests"),
    ],
)
def test_what_is_missing_or_altered_is_noted(
    damage: Callable[[Path], object], note: str, lost: str, whole: Dataset
) -> None:
    damage(whole.root)
    found, notes = seen(whole.root)
    assert notes == [note]
    assert not lost or not getattr(found, lost)
    repair(whole.root, out=whole.root.parent / "out")
    saved = Dataset.open(whole.root.parent / "out")
    assert saved.description["parents"] == [whole.identity]
    assert saved.subset_seed == (0 if lost == "subset_seed" else 7) and bool(saved.metadata) == (lost != "metadata")
