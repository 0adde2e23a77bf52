"""Read LeRobot datasets without trusting them: ours or another tool's, whole or damaged."""

import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.core.errors import CorruptDatasetError, in_short
from astra_data.dataset import columns as names
from astra_data.dataset import format as layout
from astra_data.dataset.columns import Array, Column
from astra_data.dataset.format import UNREADABLE, open_parquet, read_blocks, to_numpy

TIMESTAMP_TOLERANCE_S = 1e-4  # as LeRobot's own; what float32 cannot tell apart is allowed beside it
EPISODES_AT_ONCE = 100  # rows of meta/episodes held in memory, rounded up to whole row groups
MOST_FPS = 2**31  # upper bound of steps per second
NUMBERS = ("bool", "float16", "float32", "float64", *(f"{u}int{bits}" for u in ("", "u") for bits in (8, 16, 32, 64)))
_END_FLAGS = (names.TERMINATED, names.TRUNCATED, names.DONE)
_DATA_PATH = re.compile(r"([\w./ -]|\{(chunk|file)_index(:0?\d{1,2}d)?\})+")
_LOCATION = ("episode_index", "length", "dataset_from_index", "data/chunk_index", "data/file_index")
_FORMAT_2 = {"tasks": "meta/tasks.jsonl", "episodes": "meta/episodes.jsonl"}  # files of LeRobot's formats 2.0 and 2.1
_FORMAT_2_DATA = "data/chunk-{:03d}/episode_{:06d}.parquet"  # likewise, one for each episode
PLAIN_STATISTICS = ("min", "max", "mean", "std", "count")  # those that every file of the format has of every column
_MOST_ROWS = 10**12
_MOST_BYTES = 2**28  # of a file of metadata in JSON


class PlainColumn(NamedTuple):
    """A column of numbers: any numpy `dtype`, `size` values per step."""

    name: str
    dtype: str
    size: int


class Place(NamedTuple):
    """Where the metadata have an episode: its steps, its first row in the dataset, and its file."""

    length: int
    first_row: int | None = None
    path: Path | None = None


@dataclass(frozen=True)
class Run:
    """Consecutive rows of a file, from its `row` on: one episode, unless the dataset is damaged."""

    path: Path
    row: int
    columns: Mapping[str, Array]

    def __len__(self) -> int:
        return len(self.columns[names.EPISODE_INDEX])


def plain_columns(features: Mapping[str, Any]) -> tuple[list[PlainColumn], list[str]]:
    """Return the numeric columns of `features`, and the names of all others."""
    columns, others = [], []
    for name, feature in features.items():
        shape, dtype = (feature.get(key) if isinstance(feature, Mapping) else None for key in ("shape", "dtype"))
        size = shape[0] if isinstance(shape, Sequence) and len(shape) == 1 else None
        if dtype in NUMBERS and type(size) is int and 0 < size <= names.MOST_VALUES:
            columns.append(PlainColumn(name, dtype, size))
        else:
            others.append(name)
    return columns, others


def read_object(path: Path) -> dict[str, Any] | str:
    """Return the JSON object in the file at `path`, or what is wrong with it."""
    if path.exists() and not path.is_file():
        return "is a folder, a device or a pipe, expected a file"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return "is missing"
    except (OSError, RecursionError, ValueError) as error:
        return f"is no JSON object ({error})"
    return found if isinstance(found, dict) else f"is no JSON object but {type(found).__name__}"


def is_format_2(root: Path) -> bool:
    """Return whether the metadata in folder `root` are those of LeRobot's formats 2.0 and 2.1."""
    info = read_object(root / layout.INFO_PATH)
    return isinstance(info, dict) and str(info.get("codebase_version")).startswith("v2.")


def is_data_path(pattern: object) -> bool:
    """Return whether `pattern` is a path inside the dataset, of chunk_index and file_index only."""
    if not isinstance(pattern, str) or not _DATA_PATH.fullmatch(pattern):
        return False
    path = PurePosixPath(pattern)
    return not path.is_absolute() and ".." not in path.parts


def read_places(root: Path, info: Mapping[str, Any]) -> tuple[dict[int, Place], list[str]]:
    """Return where the metadata have each episode, as far as they can be read, and their faults."""
    places, faults = dict[int, Place](), list[str]()
    if is_format_2(root):
        rows = _read_lines(root / _FORMAT_2["episodes"])
        if isinstance(rows, str):
            return places, [f"{_FORMAT_2['episodes']} {rows}"]
        first, chunks = 0, _whole(info.get("chunks_size")) or layout.CHUNK_SIZE
        for row in rows:
            number, length = (_whole(row.get(key)) for key in ("episode_index", "length"))
            if number is None or length is None:
                return places, [f"{_FORMAT_2['episodes']} has no whole numbers as episode_index and length"]
            places[number] = Place(length, first, root / _FORMAT_2_DATA.format(number // chunks, number))
            first += length
        return places, []
    pattern = str(info.get("data_path")) if is_data_path(info.get("data_path")) else None
    for path in episodes_files(root):
        try:
            for row in (row for block in read_blocks([path], _LOCATION) for row in block.to_pylist()):
                facts = (row.get(name) for name in _LOCATION)
                number, length, start, chunk, file = (fact if type(fact) is int else None for fact in facts)
                if number is None or length is None:
                    raise CorruptDatasetError(f"{path.name} has no whole episode_index or length")
                located = pattern if None not in (chunk, file) else None
                inside = root / located.format(chunk_index=chunk, file_index=file) if located else None
                places[number] = Place(length, start, inside)
        except (*UNREADABLE, CorruptDatasetError) as error:
            faults.append(f"{path.name}: {in_short(error)}")
    return places, faults


def _whole(value: object) -> int | None:
    """Return a number of rows, episodes or files; None if it is none."""
    return value if type(value) is int and 0 <= value < _MOST_ROWS else None


def missing_files(root: Path, places: Mapping[int, Place]) -> list[str]:
    """Return the data files of `places` that are not in folder `root`, by their paths inside it."""
    paths = sorted({place.path for place in places.values() if place.path is not None})
    return [str(path.relative_to(root)) for path in paths if not path.is_file()]


def _read_lines(path: Path) -> list[dict[str, Any]] | str:
    """Return the JSON objects in the file at `path`, one a line, or what is wrong with it."""
    if not path.is_file():
        return "is missing"
    try:
        if path.stat().st_size > _MOST_BYTES:
            return f"has more than {_MOST_BYTES:,} bytes"
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    except (OSError, RecursionError, ValueError) as error:
        return f"cannot be read ({in_short(error)})"
    return rows if all(isinstance(row, dict) for row in rows) else "has a line that is no JSON object"


def read_tasks(root: Path) -> dict[int, str] | str:
    """Return the tasks by task_index, or what is wrong with their file; the name of the text column varies."""
    if is_format_2(root):
        rows = _read_lines(root / (name := _FORMAT_2["tasks"]))
        if isinstance(rows, str):
            return f"is not there in format 2, and {name} {rows}"
        if not rows or not all(type(row.get("task_index")) is int and isinstance(row.get("task"), str) for row in rows):
            return f"is not there in format 2, and {name} has no text for each task_index"
        return {row["task_index"]: row["task"] for row in rows}
    table = read_small_table(root / layout.TASKS_PATH)
    if isinstance(table, str):
        return table
    numbers = [field.name for field in table.schema if pa.types.is_integer(field.type)]
    texts = [field.name for field in table.schema if field.type in (pa.string(), pa.large_string())]
    if (table.num_columns, numbers, len(texts)) != (2, [names.TASK_INDEX], 1):
        found = ", ".join(f"{field.name} ({field.type})" for field in table.schema)
        return f"has the columns {found}, expected {names.TASK_INDEX} and one of texts"
    tasks = {row[names.TASK_INDEX]: row[texts[0]] for row in table.to_pylist()}
    if len(tasks) < len(table) or any(column.null_count for column in table.columns):
        return f"lists {table.to_pylist()}, expected one text per {names.TASK_INDEX}"
    return tasks


def _opened[T](path: Path, fault: str, read: Callable[[pq.ParquetFile], T]) -> T | str:
    """Return what `read` returns of the parquet file at `path`, or what is wrong with it."""
    try:
        with open_parquet(path) as file:
            return read(file)
    except FileNotFoundError:
        return "is missing"
    except UNREADABLE as error:
        return f"{fault} ({in_short(error)})"


def read_small_table(path: Path) -> pa.Table | str:
    """Return the parquet file at `path`, or what is wrong with it."""

    def read(file: pq.ParquetFile) -> pa.Table:
        table = file.read()  # not with read_table, which imports pandas
        table.validate(full=True)
        return table.select(table.column_names)  # raises where names are not valid UTF-8

    return _opened(path, "cannot be read", read)


def read_footer(path: Path) -> tuple[int, pa.Schema] | str:
    """Return the number of rows and the schema of the parquet file at `path`, or what is wrong with it."""
    return _opened(path, "is truncated or no parquet file", lambda file: (file.metadata.num_rows, file.schema_arrow))


def data_files(root: Path) -> list[Path]:
    """Return the data files in order."""
    return sorted((root / "data").glob("*/*.parquet"))


def episodes_files(root: Path) -> list[Path]:
    """Return the files of meta/episodes in order."""
    return sorted((root / "meta/episodes").glob("*/*.parquet"))


def episode_rows(root: Path, *, statistics: bool) -> Iterator[dict[str, Any]]:
    """Yield the rows of meta/episodes, with or without the episodes' statistics."""
    for table in read_blocks(episodes_files(root), most=EPISODES_AT_ONCE):
        kept = [name for name in table.column_names if statistics or not name.startswith("stats/")]
        # As Python objects, the statistics of an episode take tens of kilobytes.
        for batch in table.select(kept).to_batches(EPISODES_AT_ONCE):
            yield from batch.to_pylist()


def runs(path: Path, tables: Iterator[pa.Table], columns: Sequence[PlainColumn]) -> Iterator[Run]:
    """Split the rows of one file where episode_index changes and frame_index is 0; `run_faults` finds what is not."""
    rest: dict[str, Array] = {}
    row = 0
    for table in tables:
        if faults := schema_faults(table.schema, columns):
            raise CorruptDatasetError(f"{path.parent.name}/{path.name}: {'; '.join(faults)}")
        block = block_values(table, columns)
        rest = {name: np.concatenate([rest[name], block[name]]) for name in block} if rest else block
        changes = np.diff(rest[names.EPISODE_INDEX]) != 0
        starts = [0, *(np.flatnonzero(changes & (rest[names.FRAME_INDEX][1:] == 0)) + 1).tolist()]
        for first, last in itertools.pairwise(starts):
            yield Run(path, row + first, {name: values[first:last] for name, values in rest.items()})
        row += starts[-1]
        rest = {name: values[starts[-1] :] for name, values in rest.items()}
    if rest and len(rest[names.EPISODE_INDEX]):
        yield Run(path, row, rest)


def schema_faults(schema: pa.Schema, columns: Sequence[PlainColumn] | Sequence[Column]) -> list[str]:
    """List the columns that `schema` lacks or has as another type."""
    faults = [f"lacks column {column.name}" for column in columns if column.name not in schema.names]
    for column in (column for column in columns if column.name in schema.names):
        found, expected = schema.field(column.name).type, layout.arrow_type(column.dtype, column.size)
        # LeRobot's merge writes lists of variable size.
        if found != expected and (column.size == 1 or found != pa.list_(expected.value_type)):
            faults.append(f"has {column.name} as {found}, expected {expected}")
    return faults


def block_values(table: pa.Table, columns: Sequence[PlainColumn]) -> dict[str, Array]:
    """Return `columns` of `table` by name, (n,) or (n, size)."""
    values = {}
    for column in columns:
        stored = table.column(column.name)
        try:
            if pa.types.is_list(stored.type):
                stored = stored.cast(layout.arrow_type(column.dtype, column.size))
            values[column.name] = to_numpy(stored, column.size, column.dtype)
        except pa.ArrowInvalid as error:
            raise CorruptDatasetError(f"{column.name}: expected {column.size} values in every row") from error
        except CorruptDatasetError as error:
            raise CorruptDatasetError(f"{column.name}: {error}") from error
    return values


def run_faults(run: Run, *, number: int, row: int, fps: float) -> Iterator[tuple[str, str]]:
    """Yield (column, sentence) for wrong values of a run, of episode `number` from row `row` of the dataset."""
    uid = run.columns.get(names.EPISODE_UID, [0])[0]
    expected = layout.reserved_values(len(run), uid=uid, episode=number, start=row, fps=fps)
    del expected[names.TASK_INDEX]  # LeRobot's datasets may have several tasks
    for name, values in run.columns.items():
        wrong = ~np.isfinite(values) if values.dtype.kind == "f" else np.zeros(values.shape, dtype=bool)
        if name == names.TIMESTAMP:
            rounding = np.spacing(expected[name].astype(np.float32))
            wrong |= np.abs(values - expected[name]) > TIMESTAMP_TOLERANCE_S + rounding
        elif name in expected:
            wrong |= values != expected[name]
        if wrong.any():
            at = tuple(int(index) for index in np.argwhere(wrong)[0])
            where = f"episode {number} frame {at[0]}" + (f" index {at[1]}" if len(at) > 1 else "")
            wanted = f", expected {expected[name][at]}" if name in expected else ", expected a finite number"
            more = f" ({int(wrong.sum())} values are wrong)" if wrong.sum() > 1 else ""
            if name == names.TIMESTAMP and len(values) > 1:
                step = (steps := np.diff(values)).mean()
                if np.abs(steps - step).max() < 0.01 * step < np.abs(step - 1 / fps):
                    more += f": they are {1 / step:.4g} a second, the fps of {layout.INFO_PATH} is {fps:g}"
            yield name, f"{name} is {values[at]} in {where}{wanted}{more}"


def flag_faults(columns: Mapping[str, Array], where: str = "") -> Iterator[str]:
    """Yield a sentence for each flag of an episode that ends it early or contradicts another."""
    flags = {name: values != 0 for name in _END_FLAGS if (values := columns.get(name)) is not None and values.ndim == 1}
    for name, values in flags.items():
        if values[:-1].any():
            last = len(values) - 1
            yield f"{name} is True in {where}frame {values.argmax()}, before the last frame {last}"
    if len(flags) == len(_END_FLAGS):
        expected = flags[names.TERMINATED] | flags[names.TRUNCATED]
        wrong = flags[names.DONE] != expected
        if wrong.any():
            at = wrong.argmax()
            found = f"{names.DONE} is {flags[names.DONE][at]} in {where}frame {at}"
            yield f"{found}, expected {expected[at]}: terminated or truncated"


def open_end_faults(columns: Mapping[str, Array], where: str = "") -> Iterator[str]:
    """Yield a sentence if an episode has flags, and its last frame is not done."""
    done = columns.get(names.DONE)
    if done is not None and done.ndim == 1 and not done[-1]:
        yield f"{names.DONE} is False in {where}frame {len(done) - 1}, expected True: it ends there"
