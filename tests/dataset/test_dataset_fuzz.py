"""Whatever a dataset holds: it is read, or one clear message. Nothing hangs, nothing ends in a traceback."""

import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from damaged import DATA, EPISODES, declare
from fake_dataset import write_fake
from fuzzing import Edit, broken, edits, fuzzed, places, shares
from hypothesis import given
from hypothesis import strategies as st

from astra_data.core.errors import AstraDataError
from astra_data.dataset.doctor.check import check
from astra_data.dataset.doctor.repair import repair
from astra_data.dataset.inspection import inspect_dataset
from astra_data.dataset.reader import Dataset

INFO = "meta/info.json"
JSON = (INFO, "meta/stats.json", "meta/astra/dataset.json", "meta/astra/subsets.json")
PARQUET = (DATA, EPISODES, "meta/tasks.parquet", "meta/astra/episodes.parquet")


@cache
def sound() -> Path:
    return write_fake(Path(tempfile.mkdtemp()) / "set").root


@contextmanager
def copied() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(shutil.copytree(sound(), Path(folder) / "set"))


def read(root: Path) -> None:
    """Do with the dataset what people do; leave nothing half done."""
    for use in (
        lambda: list(Dataset.open(root).episodes()),
        lambda: Dataset.open(root).verify(),
        lambda: inspect_dataset(Dataset.open(root)),
        lambda: check(root).faults,
        lambda: repair(root, out=root.parent / "out"),
    ):
        try:
            use()
        except AstraDataError as error:
            assert str(error)
    out = root.parent / "out"
    assert not out.exists() or Dataset.open(out).verify() == []
    assert {path.name for path in root.parent.iterdir()} <= {"set", "out"}


def double(name: str) -> Callable[[Path], None]:
    """Give a column another of the same name."""

    def damage(root: Path) -> None:
        table = pq.read_table(root / name)
        pq.write_table(table.append_column(table.schema.field(0), table.column(0)), root / name)

    return damage


def empty(*files: str) -> Callable[[Path], None]:
    """Leave no rows."""

    def damage(root: Path) -> None:
        for name in files:
            pq.write_table(pq.read_table(root / name).slice(0, 0), root / name)

    return damage


def pipe(name: str) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        (root / name).unlink(missing_ok=True)
        os.mkfifo(root / name)

    return damage


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    **{f"{name} has a column twice": (double(name), "more than once|was altered") for name in PARQUET},
    "no rows in the data": (empty(DATA), "there are no steps"),
    "no rows anywhere": (empty(*PARQUET), "there are no steps"),
    **{f"{name} is a pipe": (pipe(name), "a device or a pipe|was altered") for name in (*JSON, *PARQUET)},
    "a pipe beside the data": (pipe("data/chunk-000/file-001.parquet"), "a device or a pipe"),
    "another pipe": (pipe("data/pipe"), "data/pipe does not belong to it"),
    "a shape of 2^30": (declare("action", shape=[2**30], names=None), "was altered"),
    "a name of 300 letters": (declare("x" * 300, dtype="float32", shape=[1]), "lacks column xxx"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_hostile_values_are_told(kind: str) -> None:
    damage, told = DAMAGE[kind]
    with copied() as root:
        damage(root)
        faults = check(root).faults
        assert faults
        assert any(re.search(told, fault) for fault in faults), faults
        read(root)


@given(name=st.sampled_from([*JSON, *PARQUET]), changes=edits)
@fuzzed(10)
def test_broken_files(name: str, changes: list[Edit]) -> None:
    with copied() as root:
        (root / name).write_bytes(broken((root / name).read_bytes(), changes))
        read(root)


HOSTILE: st.SearchStrategy[object] = st.one_of(
    st.sampled_from(
        [
            *(None, True, -1, 0, 1, 2**30, 2**31, 2**63, 2**64, 10**30, 1e308, "", "..", "/etc/passwd"),
            *("x" * 300, "\ud800", "\0", "nan", [], {}, [[]], [2**30], [0], ["x"], {"shape": [1]}),
        ]
    ),
    st.floats(),
    st.text(max_size=4),
)


@given(name=st.sampled_from(JSON), share=shares, value=HOSTILE)
@fuzzed(10)
def test_json_with_a_hostile_value(name: str, share: float, value: object) -> None:
    with copied() as root:
        content = json.loads((root / name).read_text())
        every = list(places(content))
        *path, last = every[int(share * len(every))]
        inner = content
        for key in path:
            inner = inner[key]
        inner[last] = value
        (root / name).write_text(json.dumps(content))
        read(root)
