"""What a damaged dataset still tells: what is lost is noted, and nothing is made up without a word."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from damaged import alter, drop, edit, reseal, retype, write
from fake_dataset import COLUMNS, DESCRIPTION, fake_episodes, write_fake

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset.columns import NEXT_STATE
from astra_data.dataset.doctor.repair import Remains, remains_of
from astra_data.dataset.format import DATASET_PATH, DIGESTS_PATH, INFO_PATH, METADATA_PATH, SUBSETS_PATH
from astra_data.dataset.reader import Dataset

INFO, TASKS = INFO_PATH, "meta/tasks.parquet"
SEED_0 = "the order of the subsets is that of seed 0"
WAS = "was altered after it was written"
LOST = "success, return and the like of the episodes are lost"


@pytest.fixture
def whole(tmp_path: Path) -> Dataset:
    return write_fake(tmp_path / "set", subset_seed=7)


def seen(root: Path, *sources: Dataset) -> tuple[Remains, list[str]]:
    notes: list[str] = []
    return remains_of(root, sources, notes), notes


def features(root: Path, change: Callable[[dict[str, dict[str, object]]], object]) -> None:
    info = json.loads((root / INFO).read_text())
    change(info["features"])
    (root / INFO).write_text(json.dumps(info))


def test_of_a_whole_dataset_all_is_known(whole: Dataset) -> None:
    found, notes = seen(whole.root)
    assert notes == []
    assert (found.specs, found.fps, found.tasks, found.rows) == (whole.schema, 20, {0: "run"}, None)
    assert {column.name for column in found.columns} == whole.features.keys()
    assert found.metadata == {episode.uid: episode.metadata for episode in fake_episodes()}
    assert found.digests.keys() == whole.features.keys()
    assert (found.old["content_hash"], found.subset_seed) == (whole.content_hash, 7)
    described = {key: found.description[key] for key in ("name", "version", "stage", "seeds", "parents")}
    assert described == {
        "name": "fake",
        "version": "1.1.0",
        "stage": "repair",
        "seeds": DESCRIPTION["seeds"],
        "parents": [whole.identity],
    }


@pytest.mark.parametrize(
    ("damage", "note", "lost"),
    [
        (drop(SUBSETS_PATH), f"{SUBSETS_PATH} is missing: {SEED_0}", "subset_seed"),
        (
            write(SUBSETS_PATH, b"{"),
            f"{SUBSETS_PATH} {WAS}: {SEED_0}",
            "subset_seed",
        ),
        (drop(METADATA_PATH), f"{METADATA_PATH} is missing: {LOST}", "metadata"),
        (
            alter(METADATA_PATH, "return", 0, 9.0),
            f"{METADATA_PATH} {WAS}: {LOST}",
            "metadata",
        ),
        (drop(TASKS), f"{TASKS} is missing: the task is unknown", "tasks"),
        (
            alter(TASKS, "task", 0, "sit"),
            f"{TASKS} {WAS}: the task may be wrong",
            "",
        ),
        (
            edit(INFO, fps=10),
            f"{INFO} {WAS}: names, units and fps may be wrong",
            "",
        ),
        (
            drop(DIGESTS_PATH),
            f"{DIGESTS_PATH} is missing: the values were compared with the content hash only, as a whole",
            "digests",
        ),
    ],
)
def test_what_is_missing_or_altered_is_noted(
    damage: Callable[[Path], object], note: str, lost: str, whole: Dataset
) -> None:
    damage(whole.root)
    found, notes = seen(whole.root)
    assert notes == [note]
    assert not lost or not getattr(found, lost)
    assert found.description["parents"] == [whole.identity]


@pytest.mark.parametrize("seed", ["7", None, 7.5])
def test_a_seed_that_is_no_number_is_noted(seed: object, whole: Dataset) -> None:
    edit(SUBSETS_PATH, seed=seed)(whole.root)
    reseal(whole.root)
    found, notes = seen(whole.root)
    assert notes == [f"{SUBSETS_PATH} has no whole number as its seed: {SEED_0}"]
    assert found.subset_seed == 0


@pytest.mark.parametrize("uid", [None, "7", [7]])
def test_metadata_without_uids_are_noted(uid: object, whole: Dataset) -> None:
    retype(METADATA_PATH, "episode_uid", uid)(whole.root)
    reseal(whole.root)
    found, notes = seen(whole.root)
    assert notes == [f"{METADATA_PATH} has no uids: {LOST}"]
    assert found.metadata == {}


def test_without_a_sound_description_the_origin_is_unknown(whole: Dataset) -> None:
    edit(DATASET_PATH, version="9.0.0")(whole.root)
    found, [note] = seen(whole.root)
    assert note == f"{DATASET_PATH} was altered: the origin is unknown"
    assert found.old == {}
    assert found.description == {
        "name": "set",
        "stage": "repair",
        "config": {"folder": "set"},
        "environment": {},
    }


def test_columns_that_become_others_are_noted(whole: Dataset) -> None:
    def change(known: dict[str, dict[str, object]]) -> None:
        known["mode"]["dtype"] = "float64"
        known["camera"] = {"dtype": "video", "shape": [8, 8, 3]}

    features(whole.root, change)
    found, notes = seen(whole.root)
    assert "left out, because they are not numeric: camera" in notes
    assert "mode was float64 and is now float32" in notes
    assert {spec.name: spec.dtype for spec in found.specs}["mode"] == "float32"


def test_what_lerobot_recorded_gets_next_states(whole: Dataset) -> None:
    shutil.rmtree(whole.root / "meta/astra")
    features(whole.root, lambda known: known.pop("episode_uid"))
    found, notes = seen(whole.root)
    assert notes == []
    assert found.rows is not None and found.rows.dropped == 1
    assert {column.name for column in COLUMNS} | {NEXT_STATE} == {spec.name for spec in found.specs}
    assert (found.old, found.digests, found.metadata, found.subset_seed) == ({}, {}, {}, 0)


def test_of_what_lerobots_tools_made_the_sources_tell(whole: Dataset, tmp_path: Path) -> None:
    other = write_fake(tmp_path / "other", description={**DESCRIPTION, "name": "walks"})
    shutil.copytree(whole.root, tmp_path / "merged")
    found, notes = seen(tmp_path / "merged", whole, other)
    # What LeRobot's tools left of our metadata is true no more.
    assert notes == []
    assert (found.old, found.digests, found.metadata, found.subset_seed) == ({}, {}, {}, 7)
    assert found.description["parents"] == [whole.identity, other.identity]
    features(tmp_path / "merged", lambda known: known.pop("episode_uid"))
    with pytest.raises(BadInputError, match="has no column episode_uid, by which it joins fake"):
        seen(tmp_path / "merged", whole)


@pytest.mark.parametrize(
    ("damage", "fault"),
    [
        (drop(INFO), "is missing; without it columns and fps are unknown"),
        (edit(INFO, fps=12.5), "expected a whole number of frames per second"),
        (
            edit(INFO, features={}),
            "lacks the columns episode_index, frame_index, index, task_index, timestamp",
        ),
    ],
)
def test_without_columns_and_rate_nothing_is_known(
    damage: Callable[[Path], object], fault: str, whole: Dataset
) -> None:
    damage(whole.root)
    with pytest.raises(CorruptDatasetError, match=fault):
        seen(whole.root)
