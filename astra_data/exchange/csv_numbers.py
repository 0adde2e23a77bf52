"""The fields of CSV logs as numbers, before it is known what they are."""

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import csv

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.exchange.importers.csv import (
    check_header,
    delimiter_of,
    explained,
    line_of,
    torn_bytes,
    without_blanks,
    without_end,
)
from astra_data.exchange.recording import Source

MOSTLY = 0.9
"""Share of a field's rows with a number above which the others are faults."""
_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?\s*|[+-]?(nan|inf)", re.IGNORECASE)


def read_numbers(path: Path, numbered: re.Pattern[str]) -> dict[str, Floats]:
    """Return the fields (T,) of a CSV file as numbers; true and false are 1 and 0.

    Texts and dates are NaN, but where the name of their field is one of those `numbered`: there equal ones
    have the same number.

    A last line that is cut off is left out.

    Raises:
        BadInputError: it is no CSV in UTF-8, is parted by other marks, has no numbers, or a field of numbers
            has a text or the name of another.
    """
    delimiter, mark = delimiter_of(path.name)
    source = Source(path, None, path)
    try:
        with explained(str(path), source):
            with path.open("rb") as stream:
                check_header(str(path), stream)
            with without_end(source, torn_bytes(source)) as stream:
                table = csv.read_csv(stream, parse_options=csv.ParseOptions(delimiter=delimiter))
            named = list(zip(table.column_names, table.columns, strict=True))
    except FileNotFoundError:
        raise BadInputError(f"{path}: there is no such file") from None
    fields = [(name, values) for name, values in named if name or not pa.types.is_null(values.type)]
    for name, values in fields:
        if pa.types.is_string(values.type) and (wrong := _no_number(values.to_pylist())):
            line = line_of(source, wrong[0])
            raise BadInputError(f"{path} line {line}: {name}: expected a number, got {wrong[1]!r}")
    numbers = {
        name: _as_numbers(values, is_numbered=bool(numbered.fullmatch(plain_name(name))))
        for name, values in fields
    }
    names = [name for name, _ in fields]
    usable = [name for name, values in numbers.items() if np.isfinite(values).any()]
    if len(table) < 2:
        raise BadInputError(
            f"{path}: expected two rows or more below its header, got {len(table)}: leave it out"
        )
    if not usable or any(names.count(name) > 1 for name in usable):
        raise BadInputError(
            f"{path}: expected a header of different names, and rows of numbers below it, parted by {mark}"
        )
    return numbers


def torn_files(paths: Iterable[Path]) -> tuple[str, ...]:
    """Return which CSV files end within a row, as where a battery went empty."""
    return tuple(str(path) for path in paths if torn_bytes(Source(path, None, path)))


def _as_numbers(values: pa.ChunkedArray, *, is_numbered: bool) -> Floats:
    """Return a field (T,) as numbers; texts and dates are NaN, or numbered."""
    kinds = (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean)
    if any(kind(values.type) for kind in kinds):
        numbers: Floats = values.cast(pa.float64(), safe=False).to_numpy()
        return numbers
    if pa.types.is_string(values.type):
        with suppress(pa.ArrowInvalid):
            numbers = without_blanks(values).cast(pa.float64()).to_numpy()
            return numbers
    if is_numbered and not values.null_count:
        numbers = np.unique(values.to_numpy(), return_inverse=True)[1].astype(np.float64)
        return numbers
    return np.full(len(values), np.nan)


def plain_name(name: str) -> str:
    """Return a field's name in small letters, digits and single underscores; ° is deg, and ² and ^2 are 2."""
    spelled = name.lower().replace("°", " deg ").replace("²", "2").replace("^", "")
    return re.sub(r"[^a-z0-9]+", "_", spelled).strip("_")


def _no_number(values: Sequence[str]) -> tuple[int, str] | None:
    """Return the row and the text of the first of `values` that is no number, if nearly all others are."""
    texts = [(row, value) for row, value in enumerate(values) if value and value.strip()]
    wrong = [(row, value) for row, value in texts if not _NUMBER.fullmatch(value)]
    return wrong[0] if wrong and len(wrong) < (1 - MOSTLY) * len(values) else None
