from datetime import datetime, timedelta
from decimal import Decimal
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fake_dataset import write_fake
from recordings import LOG

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, STATE
from astra_data.io.importers import parquet
from astra_data.io.importing import from_huggingface
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import Source


def read(path: Path, columns: dict[str, pa.Array | list[Any]]) -> dict[str, np.ndarray[Any, Any]]:
    """Write `columns` and return them as they are read."""
    pq.write_table(pa.table(columns), path)
    fields = {name: {"fields": (name,)} for name in columns}
    mapping = ImportMapping.model_validate({"name": "n", "task": "t", "fps": 1, "columns": fields})
    [block] = parquet.read(Source(path, None, path), mapping)
    return dict(block.values)


def test_every_kind_of_number_and_list_is_read(tmp_path: Path) -> None:
    start = datetime(2026, 1, 1)
    times = [start + timedelta(milliseconds=20 * step) for step in range(3)]
    matrix = np.arange(18.0).reshape(3, 3, 2)
    got = read(
        tmp_path / "log.parquet",
        {
            "observation.state": pa.FixedSizeListArray.from_arrays(pa.array(np.arange(6.0)), 2),
            "variable": pa.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], pa.list_(pa.int32())),
            "matrix": matrix.tolist(),
            "half": pa.array(np.array([0.5, 1.5, -2.0], np.float16)),
            "flag": [True, False, True],
            "gait": pa.array(["walk", "run", "walk"]).dictionary_encode(),
            "level": pa.array([3, 1, 3]).dictionary_encode(),
            "time": pa.array(times, pa.timestamp("us")),
            "exact": [Decimal("1.25"), Decimal("2.50"), Decimal("-3.75")],
            "lost": [1.0, None, 3.0],
            "count": [1, None, 3],
        },
    )
    np.testing.assert_array_equal(got["observation.state"], [[0, 1], [2, 3], [4, 5]])
    np.testing.assert_array_equal(got["variable"], [[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    np.testing.assert_array_equal(got["matrix"], matrix)
    np.testing.assert_array_equal(got["half"], [0.5, 1.5, -2.0])
    np.testing.assert_array_equal(got["flag"], [True, False, True])
    assert got["flag"].dtype == bool and got["gait"].tolist() == ["walk", "run", "walk"]
    assert got["level"].tolist() == [3, 1, 3] and np.diff(got["time"]).tolist() == [20_000, 20_000]
    assert got["exact"].tolist() == [1.25, 2.5, -3.75]
    for name in ("lost", "count"):
        np.testing.assert_array_equal(got[name], [1.0, np.nan, 3.0])


@pytest.mark.parametrize(
    ("column", "message"),
    [
        ([[1.0], [2.0, 3.0], [4.0]], "expected lists of one length"),
        ([[1.0, 2.0], None, [4.0, 5.0]], "expected lists of one length, without missing ones"),
        (pa.array([[1.0, 2.0], None, [4.0, 5.0]], pa.list_(pa.float64(), 2)), "expected lists of one length"),
        ([[1.0], [2.0, 3.0, 4.0], [5.0, 6.0]], "expected lists of one length"),
        ([[1.0], [2.0], [5.0, 6.0]], "expected lists of one length"),
        ([2**53 + 1, None, 3], "1 values are missing, and int64 has no NaN"),
        ([True, None, False], "1 values are missing, and bool has no NaN"),
    ],
)
def test_what_is_no_number_in_each_row_is_told(tmp_path: Path, column: pa.Array | list[Any], message: str) -> None:
    with pytest.raises(BadInputError, match=rf"log\.parquet: field 'a': {message}"):
        read(tmp_path / "log.parquet", {"a": column})


def test_the_values_of_lists_count_and_those_of_other_columns_do_not(tmp_path: Path) -> None:
    lists = pa.FixedSizeListArray.from_arrays(pa.array(np.zeros(3000)), 3)
    path = tmp_path / "log.parquet"
    pq.write_table(pa.table({"x": lists, "xy": np.zeros(1000)}), path)
    mapping = ImportMapping.model_validate({"name": "n", "task": "t", "fps": 1, "columns": {"x": {"fields": ("x",)}}})
    with pytest.raises(BadInputError, match="holds values of 24000 bytes or more"):
        next(parquet.read(Source(path, None, path, most_bytes=23_999), mapping))
    assert len(next(parquet.read(Source(path, None, path, most_bytes=24_000), mapping)))


FRAMES = f"""{LOG}[columns."observation.state"]
fields = ["observation.state"]
[columns.action]
fields = ["action"]
[split]
field = "episode_index"
"""


def test_a_dataset_comes_back_but_for_last_rows_without_a_next_state(tmp_path: Path) -> None:
    fake = write_fake(tmp_path / "fake")
    (tmp_path / "mapping.toml").write_text(FRAMES)
    again = from_huggingface(fake.to_huggingface(), tmp_path / "mapping.toml", out=tmp_path / "out")
    assert again.lengths.tolist() == [length - 1 for length in fake.lengths if length > 1]
    last = np.cumsum(fake.lengths) - 1
    for name, values in fake.columns([STATE, ACTION]).items():
        np.testing.assert_array_equal(again.columns([name])[name], np.delete(values, last, axis=0))
    assert again.reference == "log@data-1.0.0"


def test_rows_that_do_not_fit_are_told(tmp_path: Path) -> None:
    (tmp_path / "mapping.toml").write_text(FRAMES)
    rows = datasets.Dataset.from_dict({"observation.state": [[0.0]], "episode_index": [0]})
    with pytest.raises(BadInputError, match="no field 'action'"):
        from_huggingface(rows, tmp_path / "mapping.toml", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
