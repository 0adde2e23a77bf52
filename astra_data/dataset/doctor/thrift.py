"""Thrift's compact protocol, in which parquet writes its headers and footers; independent of their fields.

A struct is a dict of field number to (type, value), a list is (type, values).
"""

import struct
from typing import Any

TRUE, FALSE, BYTE, I16, I32, I64, DOUBLE, BINARY, LIST, SET, MAP, STRUCT = range(1, 13)

_LONGEST = 63
"""Bits of the longest number but its last seven."""

Struct = dict[int, tuple[int, Any]]


class Reader:
    """Reads structs from bytes; `position` moves along.

    Raises:
        ValueError: the bytes end early or are no thrift.
    """

    def __init__(self, data: bytes | memoryview, position: int = 0) -> None:
        """Start at `position`."""
        self.data = data
        self.position = position

    def struct(self) -> Struct:
        """Read one struct."""
        fields: Struct = {}
        number = 0
        while header := self._take(1)[0]:
            step, kind = header >> 4, header & 15
            number = number + step if step else self._signed()
            fields[number] = (kind, self._value(kind, kind == TRUE))
        return fields

    def _value(self, kind: int, is_true: bool = False) -> Any:  # noqa: ANN401 - any thrift value
        if kind in (TRUE, FALSE):
            return is_true
        if kind == BYTE:
            return self._take(1)[0]
        if kind in (I16, I32, I64):
            return self._signed()
        if kind == DOUBLE:
            return struct.unpack("<d", self._take(8))[0]
        if kind == BINARY:
            return bytes(self._take(self._unsigned()))
        if kind in (LIST, SET):
            header = self._take(1)[0]
            size = header >> 4 if header >> 4 < 15 else self._unsigned()
            return header & 15, [self._element(header & 15) for _ in range(size)]
        if kind == STRUCT:
            return self.struct()
        raise ValueError(f"thrift type {kind}")

    def _element(self, kind: int) -> Any:  # noqa: ANN401 - any thrift value
        # In a list, unlike in a struct, a truth value is a byte of its own.
        return self._value(kind, self._take(1)[0] == TRUE if kind in (TRUE, FALSE) else False)

    def _take(self, count: int) -> bytes | memoryview:
        taken = self.data[self.position : self.position + count]
        if len(taken) < count:
            raise ValueError("the bytes end early")
        self.position += count
        return taken

    def _unsigned(self) -> int:
        number = shift = 0
        while True:
            byte = self._take(1)[0]
            number |= (byte & 127) << shift
            if byte < 128:
                return number
            shift += 7
            if shift > _LONGEST:
                raise ValueError("a number does not end")

    def _signed(self) -> int:
        number = self._unsigned()
        return (number >> 1) ^ -(number & 1)


def encode(fields: Struct) -> bytes:
    """Return the bytes of a struct."""
    out = bytearray()
    for number, (kind, value) in sorted(fields.items()):
        written = (TRUE if value else FALSE) if kind in (TRUE, FALSE) else kind
        out += bytes([written]) + _signed(number)
        if kind not in (TRUE, FALSE):
            out += _encoded(kind, value)
    return bytes(out) + b"\0"


def _encoded(kind: int, value: Any) -> bytes:  # noqa: ANN401 - any thrift value
    if kind in (TRUE, FALSE):
        return bytes([TRUE if value else FALSE])
    if kind == BYTE:
        return bytes([value])
    if kind in (I16, I32, I64):
        return _signed(value)
    if kind == DOUBLE:
        return struct.pack("<d", value)
    if kind == BINARY:
        return _unsigned(len(value)) + bytes(value)
    if kind in (LIST, SET):
        element, values = value
        header = bytes([len(values) << 4 | element]) if len(values) < 15 else bytes([15 << 4 | element])
        length = b"" if len(values) < 15 else _unsigned(len(values))
        return header + length + b"".join(_encoded(element, each) for each in values)
    return encode(value)


def _unsigned(number: int) -> bytes:
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes([*out, number])


def _signed(number: int) -> bytes:
    return _unsigned(number << 1 if number >= 0 else -number * 2 - 1)
