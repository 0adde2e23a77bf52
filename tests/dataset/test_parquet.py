from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset import parquet
from astra_data.dataset.columns import Array
from astra_data.dataset.parquet import read_blocks, to_arrow, to_numpy


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        (np.array([0.5, -1.0, 3.0], np.float32), pa.float32()),
        (np.array([2**40, -1], np.int64), pa.int64()),
        (np.array([True, False, True]), pa.bool_()),
        (np.arange(12, dtype=np.float32).reshape(4, 3), pa.list_(pa.float32(), 3)),
        (np.array([[True, False], [False, False]]), pa.list_(pa.bool_(), 2)),
    ],
)
def test_values_go_to_arrow_and_back(values: Array, kind: pa.DataType) -> None:
    column = to_arrow(values)
    assert (column.type, column.to_pylist()) == (kind, values.tolist())
    chunks = pa.chunked_array([column[:1], column[1:]])
    size = values.shape[1] if values.ndim > 1 else 1
    back = to_numpy(chunks, size, values.dtype.name)
    assert back.dtype == values.dtype and back.flags.c_contiguous
    np.testing.assert_array_equal(back, values)


@pytest.mark.parametrize(
    ("rows", "kind", "size"),
    [
        ([1.0, None], pa.float32(), 1),
        ([[1.0, 2.0], [3.0, None]], pa.list_(pa.float32(), 2), 2),
        ([[1.0, 2.0], [3.0]], pa.list_(pa.float32()), 2),
    ],
)
def test_missing_values_are_refused(rows: list[object], kind: pa.DataType, size: int) -> None:
    with pytest.raises(CorruptDatasetError, match=f"expected {size} values in every row"):
        to_numpy(pa.chunked_array([pa.array(rows, kind)]), size, "float32")


@pytest.fixture
def paths(tmp_path: Path) -> list[Path]:
    """Two files of the numbers 0 to 9 and 10 to 14, in row groups of 4."""
    paths = [tmp_path / "a.parquet", tmp_path / "b.parquet"]
    for path, numbers in zip(paths, (range(10), range(10, 15)), strict=True):
        pq.write_table(pa.table({"x": numbers, "y": numbers}), path, row_group_size=4)
    return paths


@pytest.mark.parametrize(
    ("block_rows", "blocks"), [(1, [4, 4, 2, 4, 1]), (5, [8, 2, 5]), (8, [8, 2, 5]), (100, [10, 5])]
)
def test_blocks_are_whole_row_groups_of_one_file(
    paths: list[Path], monkeypatch: pytest.MonkeyPatch, block_rows: int, blocks: list[int]
) -> None:
    monkeypatch.setattr(parquet, "BLOCK_ROWS", block_rows)
    tables = list(read_blocks(paths))
    assert [len(table) for table in tables] == blocks
    assert [x for table in tables for x in table.column("x").to_pylist()] == list(range(15))


@pytest.mark.parametrize("block_rows", [1, 5, 100])
def test_only_wanted_rows_are_read(paths: list[Path], monkeypatch: pytest.MonkeyPatch, block_rows: int) -> None:
    monkeypatch.setattr(parquet, "BLOCK_ROWS", block_rows)
    for rows in ([], [0], [3, 4], [9, 10], [14], [*range(15)]):
        tables = list(read_blocks(paths, ["x"], np.isin(np.arange(15), rows)))
        assert [x for table in tables for x in table.column("x").to_pylist()] == rows
        assert all(table.column_names == ["x"] for table in tables)
