from pathlib import Path

import h5py
import numpy as np
import pytest

from astra_data.exchange.hdf5_file import hdf5_file

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
