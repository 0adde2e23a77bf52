from pathlib import Path

import h5py
import numpy as np
import pytest

from astra_data.core.errors import BadInputError
from astra_data.io.hdf5_file import (
    check_storage,
    hdf5_file,
    refuse_links,
    stored_datasets,
    unpacked_bytes,
)

FULL = Path("/dev/full")
"""Every write to it fails: no space is left."""


def test_values_come_back(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=(1000, 3))
    with hdf5_file(tmp_path / "a.h5", track_order=True) as (file, disk):
        for name in disk.until_it_fails(["b", "a"]):
            file[name] = values
            del file[name]  # what was written is read back, cut and written over
            file[name] = values
    with h5py.File(tmp_path / "a.h5") as again:
        assert list(again) == ["b", "a"]
        np.testing.assert_array_equal(again["b"], values)
        np.testing.assert_array_equal(again["a"], values)


def test_a_failure_that_only_the_close_meets_is_raised() -> None:
    with pytest.raises(OSError, match="No space left"), hdf5_file(FULL) as (file, _):
        file["a"] = 1


def test_nothing_more_is_made_once_a_write_has_failed() -> None:
    made = []
    with pytest.raises(OSError, match="No space left"), hdf5_file(FULL) as (file, disk):
        for number in disk.until_it_fails(range(1000)):
            made.append(number)
            file[str(number)] = np.zeros(10000)
    assert len(made) < 10


def test_what_hdf5_stumbles_over_after_a_failed_write_is_not_the_reason() -> None:
    with pytest.raises(OSError, match="No space left"), hdf5_file(FULL) as (file, disk):
        file["a"] = np.zeros(10000)
        assert disk.failure
        raise RuntimeError("address overflowed")


def test_other_errors_stay_as_they_are(tmp_path: Path) -> None:
    with pytest.raises(KeyError), hdf5_file(tmp_path / "a.h5") as (file, _):
        file["nothing"]


def test_only_what_the_file_holds_is_taken(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["group/x"] = np.zeros((4, 2))
        file.create_dataset("claimed", (10**9,), "f8", chunks=(1000,))
        datasets = stored_datasets(h5py, file)
        assert sorted(datasets) == ["claimed", "group/x"]
        assert unpacked_bytes({"x": datasets["group/x"]}) == 64
        check_storage({"x": datasets["group/x"]}, "a.hdf5")
        with pytest.raises(BadInputError, match=r"a.hdf5: field 'claimed' claims the shape"):
            check_storage(datasets, "a.hdf5")
        refuse_links(h5py, file, "a.hdf5")
        file["link"] = h5py.SoftLink("/group/x")
        with pytest.raises(BadInputError, match=r"a.hdf5: link: expected no links"):
            refuse_links(h5py, file, "a.hdf5")


def test_what_was_never_written_is_not_read_as_zeros(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file.create_dataset("never", (100, 2), "f4")
        file.create_dataset("partly", (100, 2), "f4", chunks=(30, 1))[:60] = 1
        file.create_dataset("whole", (100, 2), "f4", chunks=(30, 1), compression="gzip")[:] = 0
        file.create_dataset("empty", (0, 2), "f4")
        for name in ("never", "partly"):
            with pytest.raises(BadInputError, match=f"field '{name}' was not written as a whole"):
                check_storage({name: file[name]}, "a.hdf5")
        check_storage({name: file[name] for name in ("whole", "empty")}, "a.hdf5")
