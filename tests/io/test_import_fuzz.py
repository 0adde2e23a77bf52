"""Whatever a file or a mapping holds: a dataset that verifies, or one clear message and nothing written."""

import shutil
import tarfile
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzzing import Edit, broken, edits, fuzzed
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from mcap_recordings import MAPPING as MCAP_MAPPING
from mcap_recordings import log, write_json, write_protobuf, write_ros2
from minari_recordings import episodes, write_minari
from recordings import LOG, MAPPING, TABLES, rows, write_table

from astra_data.core.errors import AstraDataError
from astra_data.dataset.reader import Dataset
from astra_data.io.importing import import_dataset

MINARI_MAPPING = f"""{LOG}[columns."observation.state"]
fields = ["observations/achieved_goal"]
[columns.action]
fields = ["actions"]
"""


def check(recording: Path, mapping: str) -> None:
    """Import `recording` next to itself, and look at what is left."""
    file = recording.parent / "mapping.toml"
    file.write_text(mapping, encoding="utf-8", errors="surrogatepass")
    before = sorted(recording.parent.iterdir())
    out = recording.parent / "out"
    try:
        import_dataset([recording], file, out=out)
    except AstraDataError as error:
        assert str(error) and sorted(recording.parent.iterdir()) == before
    else:
        assert Dataset.open(out).verify() == []


def write_archive(path: Path) -> Path:
    log_path = write_table(path.parent / "log.json", rows())
    with tarfile.open(path, "w:gz") as archive:
        archive.add(log_path, "logs/1.json")
    log_path.unlink()
    return path


FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    **{name: (lambda path: write_table(path, rows()), MAPPING) for name in TABLES},
    "log.tar.gz": (write_archive, MAPPING),
    "json.mcap": (lambda path: write_json(path, log()), MCAP_MAPPING),
    "protobuf.mcap": (lambda path: write_protobuf(path, log()), MCAP_MAPPING),
    "ros2.mcap": (lambda path: write_ros2(path, log()), MCAP_MAPPING),
}


@cache
def sound(name: str) -> bytes:
    """Return the bytes of a file that can be imported."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        FILES[name][0](path)
        return path.read_bytes()


@pytest.mark.parametrize("name", FILES)
@given(changes=edits)
@fuzzed(8)
def test_broken_files(name: str, changes: list[Edit]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(broken(sound(name), changes))
        check(path, FILES[name][1])


@given(name=st.sampled_from(sorted(FILES)), content=st.binary(max_size=300))
@example(name="log.csv", content=b"")
@fuzzed(8)
def test_random_bytes(name: str, content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        check(path, FILES[name][1])


@cache
def minari_dataset() -> Path:
    return write_minari(Path(tempfile.mkdtemp()), episodes(is_dict=True))


@given(name=st.sampled_from(["metadata.json", "main_data.hdf5"]), changes=edits)
@fuzzed(8)
def test_broken_minari_datasets(name: str, changes: list[Edit]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(shutil.copytree(minari_dataset(), Path(folder) / "log"))
        path = root / "data" / name
        path.write_bytes(broken(path.read_bytes(), changes))
        check(root, MINARI_MAPPING)


arrays = npst.arrays(
    st.one_of(npst.scalar_dtypes(), npst.byte_string_dtypes(max_len=3)),
    npst.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)


@pytest.mark.parametrize("name", ["log.npz", "log.h5"])
@given(fields=st.dictionaries(st.sampled_from(list(rows())), arrays))
@fuzzed(8)
def test_arrays_of_any_type_and_shape(name: str, fields: dict[str, Any]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        try:
            write_table(path, {field: np.zeros(4) for field in rows()} | fields)
        except (TypeError, ValueError):
            return  # HDF5 has no such type.
        check(path, MAPPING)


def test_the_files_are_sound() -> None:
    for name, (_, mapping) in FILES.items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_bytes(sound(name))
            (path.parent / "mapping.toml").write_text(mapping)
            assert import_dataset([path], path.parent / "mapping.toml", out=path.parent / "out").episodes > 0
