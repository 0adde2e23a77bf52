"""Bytes worked out by hand from thrift's compact protocol, and the footers that pyarrow writes."""

import struct
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from astra_data.dataset.doctor.salvage import (
    BINARY,
    BYTE,
    DOUBLE,
    I16,
    I32,
    I64,
    LIST,
    STRUCT,
    TRUE,
    Reader,
    Struct,
    encode,
)

CASES: list[tuple[Struct, bytes]] = [
    ({}, b"\x00"),
    ({1: (I32, 0)}, b"\x15\x00\x00"),
    ({1: (I32, -1)}, b"\x15\x01\x00"),
    ({1: (I32, 150)}, b"\x15\xac\x02\x00"),  # zigzag 300
    ({1: (I16, 1), 3: (I64, -(2**63))}, b"\x14\x02\x26" + b"\xff" * 9 + b"\x01\x00"),
    ({2: (TRUE, True), 3: (TRUE, False)}, b"\x21\x12\x00"),
    ({20: (BYTE, 7)}, b"\x03\x28\x07\x00"),  # a step above 15: the number itself, zigzag
    ({1: (DOUBLE, 1.5)}, b"\x17" + struct.pack("<d", 1.5) + b"\x00"),
    ({1: (BINARY, b"abc")}, b"\x18\x03abc\x00"),
    ({1: (LIST, (I32, [1, 2]))}, b"\x19\x25\x02\x04\x00"),
    ({1: (LIST, (BYTE, [5] * 15))}, b"\x19\xf3\x0f" + b"\x05" * 15 + b"\x00"),
    ({1: (STRUCT, {1: (I32, 1)}), 2: (I32, 2)}, b"\x1c\x15\x02\x00\x15\x04\x00"),
]


def values(fields: Struct) -> dict[int, object]:
    """Return the values alone: true and false are types of their own in the bytes."""
    return {number: value for number, (_, value) in fields.items()}


@pytest.mark.parametrize(("fields", "data"), CASES)
def test_structs_are_read_from_their_bytes(fields: Struct, data: bytes) -> None:
    reader = Reader(b"xx" + data + b"more", 2)
    assert values(reader.struct()) == values(fields)
    assert reader.position == 2 + len(data)


@pytest.mark.parametrize(("fields", "data"), CASES)
def test_written_structs_are_read_back(fields: Struct, data: bytes) -> None:
    assert Reader(encode(fields)).struct() == Reader(data).struct()


@pytest.mark.parametrize("data", [b"", b"\x15", b"\x18\x05abc", b"\x15" + b"\xff" * 11, b"\x1d\x00"])
def test_other_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"early|not end|type"):
        Reader(data).struct()


def test_a_parquet_footer_says_what_pyarrow_wrote(tmp_path: Path) -> None:
    path = tmp_path / "table.parquet"
    table = pa.table({"number": [1, 2, 3, 4, 5], "flag": [True, False, True, True, False]})
    pq.write_table(table, path, row_group_size=2)
    data = path.read_bytes()
    length = int.from_bytes(data[-8:-4], "little")
    footer = Reader(data[-8 - length : -8]).struct()
    assert footer[3][1] == 5  # FileMetaData.num_rows
    schema = footer[2][1][1]
    assert [element[4][1] for element in schema] == [b"schema", b"number", b"flag"]
    groups = footer[4][1][1]
    assert [group[3][1] for group in groups] == [2, 2, 1]
    rewritten = encode(footer)
    file = b"PAR1" + rewritten + len(rewritten).to_bytes(4, "little") + b"PAR1"
    found, expected = pq.read_metadata(pa.BufferReader(file)), pq.read_metadata(path)
    assert found.to_dict()["row_groups"] == expected.to_dict()["row_groups"]
