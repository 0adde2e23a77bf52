import hashlib
import os
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import xxhash
from damaged import DATA, EPISODES, alter, edit, reseal
from fake_dataset import concatenated, fake_episodes

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset import Dataset, description
from astra_data.dataset import format as layout
from astra_data.dataset.columns import ACTION, REWARD, STATE
from astra_data.dataset.format import DATA_PATH, DATASET_PATH, DIGESTS_PATH
from astra_data.dataset.plain import is_data_path

PARENT = {"name": "raw", "version": "1.0.0", "hash": "0"}


def test_a_description_is_completed_with_defaults_packages_and_the_machine() -> None:
    given = {"name": "walks", "stage": "pair", "parents": [PARENT], "config": {"a": (1, 2)}}
    full = description.complete_description(given)
    assert full["version"] == "1.0.0" and full["parents"] == [PARENT] and full["config"] == {"a": [1, 2]}
    assert full["packages"]["numpy"] == np.__version__ and full["machine"]["cores"] == len(os.sched_getaffinity(0))
    assert full["seeds"] == full["environment"] == full["simulator"] == {}


def test_a_malformed_description_is_refused() -> None:
    cases: tuple[tuple[dict[str, object], str], ...] = (
        ({"name": "../walks"}, "name '../walks', expected up to 200 of A-Z"),
        ({"version": "1.0"}, "version '1.0', expected three numbers"),
        ({"stage": ""}, "stage '', expected the name of the stage"),
        ({"parents": [{"name": "raw"}]}, "expected name, version and hash"),
        ({"seeds": {"collect": object()}}, "expected plain JSON"),
        ({"config": {"noise_m": float("nan")}}, "expected plain JSON"),
        ({"sead": 1}, "unknown key 'sead'"),
    )
    for change, fault in cases:
        with pytest.raises(BadInputError, match=re.escape(fault)):
            description.complete_description({"name": "walks", "stage": "pair"} | change)


def test_the_content_hash_is_sha256_of_the_columns_hashes() -> None:
    reward, state = np.arange(4, dtype=np.float32), np.arange(12, dtype=np.float32).reshape(4, 3)
    expected = hashlib.sha256()
    for name, kind, values in (("reward", "float32()", reward), ("state", "float32(3,)", state)):
        expected.update(f"{name}\0{kind}\0".encode() + hashlib.sha256(values.tobytes()).digest())
    running = description.ContentHash()
    for rows in (slice(0, 1), slice(1, 4)):  # block by block, and in another order
        running.update("state", state[rows])
        running.update("reward", reward[rows])
    assert running.hexdigest() == expected.hexdigest()
    turned = description.ContentHash()
    turned.update("reward", reward)
    turned.update("state", np.ascontiguousarray(state.reshape(3, 4)))
    assert turned.hexdigest() != expected.hexdigest()


def test_changed_values_are_found_at_any_depth() -> None:
    before = {"a": 1, "b": {"c": 2, "d": {"e": 3}}, "f": {"g": 1}}
    after = {"a": 1, "b": {"c": 2, "d": {"e": 4}}, "f": 5, "h": 6}
    assert list(description.changed_values(before, after)) == [("b.d.e", 3, 4), ("f", {"g": 1}, 5), ("h", None, 6)]


def test_a_permutation_does_not_depend_on_the_other_uids() -> None:
    order = description.permutation(range(100), seed=3)
    assert sorted(order) == list(range(100)) and order != description.permutation(range(100), seed=4)
    assert description.permutation(range(0, 100, 3), seed=3) == [uid for uid in order if uid % 3 == 0]
    # Uniform: over many seeds each uid comes first about equally often.
    first = [description.permutation(range(4), seed)[0] for seed in range(1000)]
    assert all(200 < first.count(uid) < 300 for uid in range(4))


def test_data_stays_inside_the_folder() -> None:
    assert is_data_path(DATA_PATH) is is_data_path("data/{file_index}.parquet") is True
    fields = ("episode_index", "file_index.real", "file_index:999999999d", "")
    unknown = (f"data/{{{field}}}.parquet" for field in fields)
    for pattern in ("/data/file.parquet", "data/../../file.parquet", *unknown, "", None):
        assert is_data_path(pattern) is False


def test_every_fault_of_a_forged_description_is_told_at_once(root: Path) -> None:
    edit(DATASET_PATH, name="a/b", parents=[{"name": "x"}], config=3)(root)
    reseal(root)
    with pytest.raises(CorruptDatasetError) as caught:
        description.read_description(root)
    for fault in ("name 'a/b', expected", "parent {'name': 'x'}, expected", "config 3, expected an object"):
        assert fault in str(caught.value)


def test_the_file_holds_a_digest_of_each_episode_and_column(fake: Dataset) -> None:
    table = pq.read_table(fake.root / DIGESTS_PATH)
    assert set(table.column_names) == set(fake.features)
    for name in (STATE, ACTION, REWARD, "next.done", "mode"):
        expected = [xxhash.xxh3_64(episode.columns[name].tobytes()).intdigest() for episode in fake_episodes()]
        assert table.column(name).to_pylist() == expected


@pytest.mark.parametrize("block_rows", [1, 2**16])
@pytest.mark.parametrize("rows", [3, 10, 1000])
def test_an_altered_value_is_refused_before_it_is_seen(
    root: Path, monkeypatch: pytest.MonkeyPatch, block_rows: int, rows: int
) -> None:
    monkeypatch.setattr(layout, "BLOCK_ROWS", block_rows)
    alter(DATA, REWARD, 25, 9.0)(root)
    pq.write_table(pq.read_table(root / DATA), root / DATA, row_group_size=rows)
    dataset = Dataset.open(root)
    seen = []
    with pytest.raises(CorruptDatasetError) as caught:
        seen += list(dataset.episodes([ACTION, REWARD]))
    assert len(seen) <= 3
    assert str(caught.value) == (
        f"{root} is incomplete or was altered: next.reward: other values than were written in {DATA} rows "
        "20 to 49 (episode 3). Restore it from a copy, run the stage that wrote it again, or recover its "
        f"intact episodes: `astra-data repair {root} --out FOLDER`, with `--like ORIGINAL` if LeRobot's tools "
        "edited it."
    )
    with pytest.raises(CorruptDatasetError, match=r"next\.reward"):
        dataset.columns([REWARD])
    # What was not altered is read as ever.
    np.testing.assert_array_equal(dataset.columns([ACTION])[ACTION], concatenated(ACTION))
    others = [episode.columns[REWARD] for episode in dataset.episodes([REWARD], [0, 1, 2, 4])]
    for found, expected in zip(others, [*fake_episodes()[:3], fake_episodes()[4]], strict=True):
        np.testing.assert_array_equal(found, expected.columns[REWARD])


def test_a_file_that_shrinks_while_it_is_open_is_refused(dataset: Dataset) -> None:
    table = pq.read_table(dataset.root / DATA)
    for rows in (table.slice(0, 50), pa.concat_tables([table, table.slice(0, 1)])):
        pq.write_table(rows, dataset.root / DATA)
        with pytest.raises(CorruptDatasetError, match="other rows than when the dataset was opened"):
            dataset.columns([REWARD])


def test_digests_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    (tmp_path / DIGESTS_PATH).parent.mkdir(parents=True)
    whole, torn = (pa.array([1, 2, 3, 4, last], pa.uint64()) for last in (5, None))
    for columns in ({REWARD: whole}, {REWARD: whole.cast(pa.float32()), ACTION: whole}, {REWARD: torn, ACTION: torn}):
        pq.write_table(pa.table(columns), tmp_path / DIGESTS_PATH)
        with pytest.raises(CorruptDatasetError, match="has other columns than the data"):
            description.read_digests(tmp_path, [REWARD, ACTION])


def test_the_sums_are_those_of_the_files(dataset: Dataset) -> None:
    sums = dict(dataset.description["sums"])
    sums.pop(DATASET_PATH)
    assert sums == {
        path: hashlib.sha256((dataset.root / path).read_bytes()).hexdigest() for path in (*description.SEALED, EPISODES)
    }
    assert description.altered_files(dataset.root, dataset.description) == []


@pytest.mark.parametrize("path", [*description.SEALED, EPISODES])
def test_every_sealed_file_is_known_when_altered_or_missing(path: str, dataset: Dataset) -> None:
    with (dataset.root / path).open("ab") as file:
        file.write(b" ")
    assert description.altered_files(dataset.root, dataset.description) == [path]
    (dataset.root / path).unlink()
    assert description.altered_files(dataset.root, dataset.description) == [path]


@pytest.mark.parametrize("change", [{"seeds": {}}, {"content_hash": "0" * 64}, {"more": 1}])
def test_the_description_seals_itself(change: dict[str, object], root: Path) -> None:
    edit(DATASET_PATH, **change)(root)
    with pytest.raises(CorruptDatasetError, match=r"^meta/astra/dataset\.json was altered$"):
        description.read_description(root)
    with pytest.raises(CorruptDatasetError, match=r"dataset\.json was altered.*Restore it from a copy"):
        Dataset.open(root)
