"""Logs that the task of a new robot is guessed from, of CSV files or a dataset, by field and episode."""

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa
from pyarrow import csv

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.dataset.checkup.findings import LARGEST, is_angle
from astra_data.dataset.columns import ACTION, GOAL, STATE, SUCCESS, TERMINATED, TIMESTAMP
from astra_data.dataset.reader import Dataset, refuse_run, refuse_versions
from astra_data.io.importers.csv import (
    SUFFIXES,
    check_header,
    delimiter_of,
    explained,
    line_of,
    torn_bytes,
    without_blanks,
    without_end,
)
from astra_data.io.recording import Source, refuse_dataset

Role = Literal["time", "episode", "state", "command", "goal", "failure", "success", "reward", "left out"]
TURNED = "heading|yaw|theta|psi|compass|course|cog|azimuth|hdg"
HEADING = re.compile(rf"(.+_)?({TURNED})")
RATE_HZ = 10
"""Assumed rate of logs without a time."""
MOSTLY = 0.9
"""Share of a field's rows with a number above which the others are faults."""
_EVEN = 0.005
"""Relative error of a rate that counts as a whole number."""
_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?\s*|[+-]?(nan|inf)", re.IGNORECASE)
_ROLES: dict[str, Role] = {STATE: "state", ACTION: "command", GOAL: "goal"}


@dataclass(frozen=True)
class Field:
    """One field of the logs: `name` there and `short` here; value * `scale` + `offset` is in `unit`."""

    name: str
    role: Role
    short: str
    unit: str = "1"
    scale: float = 1.0
    why: str = ""
    offset: float = 0.0

    @property
    def plain(self) -> str:
        """`short` in small letters, digits and single underscores, as patterns of names expect it."""
        return re.sub(r"[\W_]+", "_", self.short.lower()).strip("_") or self.short

    @property
    def taken_for(self) -> str:
        """Its role, with the name of a state or command."""
        return f"{self.role} {self.short}" if self.role in ("state", "command") else self.role


@dataclass(frozen=True)
class Logs:
    """Logs and what their fields are.

    Attributes:
        fields: in the order of the logs.
        episodes: scaled values (T,) of each by a field's name, in rows whose states and commands are numbers.
        left_out: how many rows lack a number, by the name of the field.
        cut_off: files whose last line is cut off and left out.
    """

    fields: tuple[Field, ...]
    episodes: tuple[dict[str, Floats], ...]
    left_out: dict[str, int]
    cut_off: tuple[str, ...] = ()

    def of(self, role: Role) -> tuple[Field, ...]:
        """Return the fields with a role."""
        return tuple(field for field in self.fields if field.role == role)

    def values(self, fields: Sequence[Field]) -> list[Floats]:
        """Return the values (T, len(fields)) of each episode."""
        return [np.stack([episode[field.name] for field in fields], axis=-1) for episode in self.episodes]

    @property
    def recorded_rate(self) -> float:
        """Rows per second without gaps and repeated rows; `RATE_HZ` where the logs have no time."""
        for field in self.of("time"):
            steps = np.concatenate([np.diff(episode[field.name]) for episode in self.episodes])
            regular = steps[(steps > 0) & (steps <= 5 * np.median(steps))]
            return 1 / float(regular.mean())
        return float(RATE_HZ)

    @property
    def rate(self) -> int:
        """The whole rate nearest to the recorded one."""
        return max(1, round(self.recorded_rate))

    @property
    def uneven(self) -> str:
        """Why the rate is no whole number, and what to do; empty where it is one within `_EVEN`."""
        error = self.recorded_rate / self.rate - 1
        if abs(error) < _EVEN:
            return ""
        off = f"{abs(error):.1%} too {'long' if error > 0 else 'short'}"
        return (
            f"the logs have {self.recorded_rate:.4g} rows per second, not a whole number: TIMESTEP_S is "
            f"{off}; resample them to {self.rate} rows per second"
        )

    @property
    def still(self) -> str:
        """Which commands never change, and the consequence; empty where all do."""
        fields = self.of("command")
        given = np.concatenate(self.values(fields)).T
        named = [f"{f.short} is {v[0]:g}" for f, v in zip(fields, given, strict=True) if not np.ptp(v)]
        what = "it does" if len(named) == 1 else "they do"
        return f"{' and '.join(named)} in all rows: no simulator can learn what {what}" if named else ""


def csv_files(place: Path) -> list[Path]:
    """Return the CSV files in a folder, or the one that `place` is.

    Raises:
        BadInputError: there is none; says what to do.
    """
    if not place.exists():
        raise BadInputError(f"{place}: no such file, folder or dataset")
    inside = sorted(place.iterdir()) if place.is_dir() else [place]
    if found := [path for path in inside if path.suffix.lower() in SUFFIXES]:
        return found
    refuse_versions(place)
    refuse_dataset(place)
    refuse_run(place)
    raise BadInputError(
        f"{place}: expected files that end in {' or '.join(SUFFIXES)}, or a dataset: make one of other "
        "recordings with `astra-data import LOGS --mapping FILE` (`astra-data recipes list` shows mappings, "
        "such as ros2_base), then name it: --from NAME"
    )


def plain_name(name: str) -> str:
    """Return a field's name in small letters, digits and single underscores; ° is deg, ² and ^2 are 2."""
    spelled = re.sub(r"(?<=[a-z]{2})(?=[A-Z])", "_", name).lower().replace("°", " deg ")
    return re.sub(r"[^a-z0-9]+", "_", spelled.replace("²", "2").replace("^", "")).strip("_")


def read_numbers(source: Source, numbered: re.Pattern[str]) -> dict[str, Floats]:
    """Return the fields (T,) of a CSV file as numbers; true and false are 1 and 0, texts and dates NaN.

    Equal texts have the same number in fields whose name is one of `numbered`. A last line that is cut off is
    left out.

    Raises:
        BadInputError: it is no CSV, has too few rows, or a field of numbers has a text or is there twice.
    """
    delimiter, mark = delimiter_of(source.path.name)
    with explained(str(source.path), source):
        with source.open() as stream:
            check_header(str(source.path), stream)
        with without_end(source, torn_bytes(source)) as stream:
            table = csv.read_csv(stream, parse_options=csv.ParseOptions(delimiter=delimiter))
    if len(table) < 2:
        found = f"expected two rows or more below its header, got {len(table)}: leave it out"
        raise BadInputError(f"{source.path}: {found}")
    numbers: dict[str, Floats] = {}
    for name, values in zip(table.column_names, table.columns, strict=True):
        if pa.types.is_string(values.type):
            texts = [(row, text) for row, text in enumerate(values.to_pylist()) if text and text.strip()]
            wrong = [(row, text) for row, text in texts if not _NUMBER.fullmatch(text)]
            if wrong and len(wrong) < (1 - MOSTLY) * len(values):
                where = f"{source.path} line {line_of(source, wrong[0][0])}: {name}"
                raise BadInputError(f"{where}: expected a number, got {wrong[0][1]!r}")
        series = _as_numbers(values, is_numbered=bool(numbered.fullmatch(plain_name(name))))
        if np.isfinite(series).any() and np.isfinite(numbers.get(name, np.nan)).any():
            raise BadInputError(f"{source.path}: expected a header of different names, got {name} twice")
        numbers[name] = series
    if not any(np.isfinite(values).any() for values in numbers.values()):
        raise BadInputError(f"{source.path}: expected rows of numbers separated by {mark} below a header")
    return numbers


def _as_numbers(values: pa.ChunkedArray, *, is_numbered: bool) -> Floats:
    """Return a field (T,) as numbers; texts and dates are NaN, or numbered."""
    kinds = (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean)
    if any(kind(values.type) for kind in kinds):
        return np.asarray(values.cast(pa.float64(), safe=False).to_numpy())
    if pa.types.is_string(values.type):
        with suppress(pa.ArrowInvalid):
            return np.asarray(without_blanks(values).cast(pa.float64()).to_numpy())
    if is_numbered and not values.null_count:
        return np.asarray(np.unique(values.to_numpy(), return_inverse=True)[1], np.float64)
    return np.full(len(values), np.nan)


def logs_of(data: Dataset) -> Logs:
    """Return the episodes of `data` as logs: its states, commands and goals by their own names, and failures.

    Raises:
        BadInputError: it has no states or commands, or a heading that is not in rad, or commands in degrees
            beside one.
        CorruptDatasetError: a file cannot be read, or values differ from their digests.
    """
    columns = data.specs([STATE, ACTION, *([GOAL] if GOAL in data.features else [])])
    fields = []
    for column in columns:
        role = _ROLES[column.name]
        names = column.names or tuple(f"{role[0]}{number}" for number in range(column.size))
        for name, unit in zip(names, column.units, strict=True):
            fields.append(Field(f"{column.name} {name}", role, name, unit or "1", why="its column"))
    ends = [name for name in (TERMINATED, SUCCESS) if name in data.features]
    episodes = []
    for episode in data.episodes([*(column.name for column in columns), *ends]):
        values = np.column_stack([episode.columns[column.name] for column in columns]).astype(float)
        found = {field.name: series for field, series in zip(fields, values.T, strict=True)}
        found[TIMESTAMP] = np.arange(len(values)) / data.info["fps"]
        success = episode.columns.get(SUCCESS, np.zeros(len(values), bool))
        found["failed"] = (episode.columns.get(TERMINATED, success) & ~success).astype(float)
        episodes.append(found)
    headings = [field for field in fields if field.role != "command" and HEADING.fullmatch(field.plain)]
    turning = [*headings, *(field for field in fields if field.role == "command" and headings)]
    wrong = [field for field in turning if field.unit in ("deg", "deg/s")]
    for number, field in enumerate(fields):
        largest = max(float(np.abs(values[field.name]).max()) for values in episodes)
        if field.role == "state" and field.unit == "1" and is_angle(field.short):
            wrong += [field] if largest > LARGEST and field in headings else []
            fields[number] = replace(field, unit="rad" if largest <= LARGEST else "1")
    if wrong:
        named = ", ".join(f"{field.name} in {field.unit}" for field in wrong)
        raise BadInputError(
            f"{data.reference} has {named}: expected rad and rad/s, as a dataset's values are taken as they "
            "are: import the logs again with a `scale` of 0.0174533 there (or with the `unit` rad if so)"
        )
    failures = sum(bool(one["failed"].any()) for one in episodes)
    why = f"terminated, and no success: {failures} of {len(episodes)} episodes"
    time = Field(TIMESTAMP, "time", "time", "s", why=f"{data.info['fps']} rows a second")
    return Logs((time, *fields, Field("failed", "failure", "failure", why=why)), tuple(episodes), {})
