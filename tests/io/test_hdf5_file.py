from pathlib import Path

import h5py
import numpy as np
import pytest

from astra_data.core.errors import BadInputError
from astra_data.io.hdf5_file import (
    check_storage,
    refuse_links,
    stored_datasets,
    unpacked_bytes,
)


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
