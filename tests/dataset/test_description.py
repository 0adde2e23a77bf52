import hashlib
import os
from pathlib import Path

import numpy as np
import pytest
from damaged import edit, reseal
from fake_dataset import write_fake

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset.description import (
    ContentHash,
    changed_values,
    complete_description,
    permutation,
    read_description,
)
from astra_data.dataset.format import DATA_PATH, DATASET_PATH
from astra_data.dataset.plain import is_data_path

PARENT = {"name": "raw", "version": "1.0.0", "hash": "0"}


def test_a_description_is_completed_with_defaults_packages_and_the_machine() -> None:
    full = complete_description(
        {"name": "walks", "stage": "pair", "parents": [PARENT], "config": {"a": (1, 2)}}
    )
    assert full["version"] == "1.0.0"
    assert full["parents"] == [PARENT]
    assert full["config"] == {"a": [1, 2]}
    assert full["packages"]["numpy"] == np.__version__
    assert full["machine"]["cores"] == len(os.sched_getaffinity(0))
    assert full["seeds"] == full["environment"] == full["simulator"] == {}


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"name": "../walks"}, "name '../walks', expected up to 200 letters"),
        ({"version": "1.0"}, "version '1.0', expected three numbers"),
        ({"stage": ""}, "stage '', expected the name of the stage"),
        ({"parents": [{"name": "raw"}]}, "expected name, version and hash"),
        ({"seeds": {"collect": object()}}, "expected plain JSON"),
        ({"config": {"noise_m": float("nan")}}, "expected plain JSON"),
        ({"sead": 1}, "unknown key 'sead'"),
    ],
)
def test_a_malformed_description_is_refused(change: dict[str, object], fault: str) -> None:
    with pytest.raises(BadInputError) as caught:
        complete_description({"name": "walks", "stage": "pair"} | change)
    assert fault in str(caught.value)


def test_the_content_hash_is_sha256_of_the_columns_hashes() -> None:
    reward, state = np.arange(4, dtype=np.float32), np.arange(12, dtype=np.float32).reshape(4, 3)
    expected = hashlib.sha256()
    for name, kind, values in (("reward", "float32()", reward), ("state", "float32(3,)", state)):
        expected.update(f"{name}\0{kind}\0".encode() + hashlib.sha256(values.tobytes()).digest())
    running = ContentHash()
    for rows in (slice(0, 1), slice(1, 4)):  # block by block, and in another order
        running.update("state", state[rows])
        running.update("reward", reward[rows])
    assert running.hexdigest() == expected.hexdigest()
    turned = ContentHash()
    turned.update("reward", reward)
    turned.update("state", np.ascontiguousarray(state.reshape(3, 4)))
    assert turned.hexdigest() != expected.hexdigest()


def test_changed_values_are_found_at_any_depth() -> None:
    before = {"a": 1, "b": {"c": 2, "d": {"e": 3}}, "f": {"g": 1}}
    after = {"a": 1, "b": {"c": 2, "d": {"e": 4}}, "f": 5, "h": 6}
    assert list(changed_values(before, after)) == [("b.d.e", 3, 4), ("f", {"g": 1}, 5), ("h", None, 6)]


def test_a_permutation_does_not_depend_on_the_other_uids() -> None:
    order = permutation(range(100), seed=3)
    assert sorted(order) == list(range(100))
    assert order != permutation(range(100), seed=4)
    assert permutation(range(0, 100, 3), seed=3) == [uid for uid in order if uid % 3 == 0]
    # Uniform: over many seeds each uid comes first about equally often.
    first = [permutation(range(4), seed)[0] for seed in range(1000)]
    assert all(200 < first.count(uid) < 300 for uid in range(4))


@pytest.mark.parametrize(
    ("pattern", "is_one"),
    [
        (DATA_PATH, True),
        ("data/{file_index}.parquet", True),
        ("/data/file.parquet", False),
        ("data/../../file.parquet", False),
        ("data/{episode_index}.parquet", False),
        ("data/{file_index.real}.parquet", False),
        ("data/{file_index:999999999d}.parquet", False),
        ("data/{}.parquet", False),
        ("", False),
        (None, False),
    ],
)
def test_data_stays_inside_the_folder(pattern: object, is_one: bool) -> None:
    assert is_data_path(pattern) is is_one


def test_every_fault_of_a_forged_description_is_told_at_once(tmp_path: Path) -> None:
    root = write_fake(tmp_path / "set").root
    edit(DATASET_PATH, name="a/b", parents=[{"name": "x"}], config=3)(root)
    reseal(root)
    with pytest.raises(CorruptDatasetError) as caught:
        read_description(root)
    for fault in ("name 'a/b', expected", "parent {'name': 'x'}, expected", "config 3, expected an object"):
        assert fault in str(caught.value)
