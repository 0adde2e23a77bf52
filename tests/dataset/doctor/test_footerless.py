from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.doctor.salvage import rebuilt_metadata


@pytest.mark.parametrize("compression", ["snappy", "zstd"])
@pytest.mark.parametrize("use_dictionary", [True, False])
def test_footers_are_rebuilt_for_many_pages_per_column(
    tmp_path: Path, compression: str, use_dictionary: bool
) -> None:
    rng = np.random.default_rng(0)
    rows = 5000
    listed = pa.FixedSizeListArray.from_arrays(pa.array(rng.normal(size=3 * rows).astype(np.float32)), 3)
    schema = pa.schema(
        [("few", pa.int64()), ("listed", listed.type), ("flag", pa.bool_()), ("many", pa.float64())]
    )
    arrays = [rng.integers(0, 3, rows), listed, rng.random(rows) < 0.5, rng.normal(size=rows)]
    table = pa.Table.from_arrays([pa.array(array) for array in arrays], schema=schema)
    for version in ("1.0", "2.0"):
        path = tmp_path / f"{version}.parquet"
        pq.write_table(
            table,
            path,
            row_group_size=2100,
            data_page_size=1000,
            write_batch_size=100,
            dictionary_pagesize_limit=4000,
            compression=compression,
            use_dictionary=use_dictionary,
            data_page_version=version,
        )
        whole = path.read_bytes()
        length = int.from_bytes(whole[-8:-4], "little")
        path.write_bytes(whole[: -8 - length])
        metadata = rebuilt_metadata(path, schema)
        assert metadata.num_row_groups == 3
        with pq.ParquetFile(path, metadata=metadata) as file:
            assert file.read().equals(table)


def test_pages_of_narrow_values_are_not_taken_for_those_of_a_wide_column(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=1000)
    table = pa.table({"narrow": values.astype(np.float32), "wide": values[::-1].copy()})
    path = tmp_path / "pages.parquet"
    pq.write_table(
        table, path, data_page_size=1, write_batch_size=250, use_dictionary=False, compression="snappy"
    )
    whole = path.read_bytes()
    path.write_bytes(whole[: -8 - int.from_bytes(whole[-8:-4], "little")])
    metadata = rebuilt_metadata(path, table.schema)
    assert metadata.num_row_groups == 1
    with pq.ParquetFile(path, metadata=metadata) as file:
        assert file.read().equals(table)


def test_a_row_group_that_lacks_its_last_byte_is_not_whole(tmp_path: Path) -> None:
    table = pa.table({"x": np.arange(30.0)})
    path = tmp_path / "cut.parquet"
    pq.write_table(table, path, row_group_size=10, compression="snappy")
    whole = path.read_bytes()
    end = len(whole) - 8 - int.from_bytes(whole[-8:-4], "little")
    for kept, groups in ((end, 3), (end - 1, 2)):
        path.write_bytes(whole[:kept])
        assert rebuilt_metadata(path, table.schema).num_row_groups == groups


@pytest.mark.parametrize("byte", [b"\x1c", b"\xff"])
def test_a_header_without_end_is_no_page(tmp_path: Path, byte: bytes) -> None:
    path = tmp_path / "endless.parquet"
    path.write_bytes(b"PAR1" + byte * 10**6)
    with pytest.raises(CorruptDatasetError, match="no whole row group"):
        rebuilt_metadata(path, pa.schema([("x", pa.int64())]))
