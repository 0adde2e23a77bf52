"""A dataset as logs: what `new` begins with, where logs are imported already or were recorded by LeRobot."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.dataset.checkup.angles import LARGEST, is_angle
from astra_data.dataset.columns import ACTION, GOAL, STATE, SUCCESS, TERMINATED, TIMESTAMP, Column
from astra_data.dataset.reader import Dataset
from astra_data.exchange.field_names import HEADING, Role
from astra_data.exchange.logs import Field, Logs

_FAILED = "failed"
_ROLES: dict[str, Role] = {STATE: "state", ACTION: "command", GOAL: "goal"}


def logs_of(data: Dataset) -> Logs:
    """Return the episodes of `data` as logs: its states, commands and goals by their own names, and failures.

    Raises:
        BadInputError: it has no states or commands, a heading or its commands are in degrees, a heading
            without a unit is too large for rad, or a value is not finite.
        CorruptDatasetError: a file cannot be read, or values differ from their digests.
    """
    fields = [Field(TIMESTAMP, "time", "time", "s", 1.0, f"{data.info['fps']} rows a second")]
    read = [STATE, ACTION, *([GOAL] if GOAL in data.features else [])]
    columns = data.specs(read)
    of_columns = [field for column in columns for field in _fields(column)]
    _refuse_degrees(of_columns, data.reference)
    fields += of_columns
    ends = [name for name in (TERMINATED, SUCCESS) if name in data.features]
    episodes, failures = [], 0
    for episode in data.episodes([*read, *ends]):
        values = np.column_stack([episode.columns[column.name] for column in columns]).astype(float)
        found = {field.name: series for field, series in zip(of_columns, values.T, strict=True)}
        found[TIMESTAMP] = np.arange(len(values)) / data.info["fps"]
        if TERMINATED in ends:
            failed = episode.columns[TERMINATED] & ~episode.columns.get(SUCCESS, np.zeros(len(values), bool))
            found[_FAILED] = failed.astype(float)
            failures += bool(failed.any())
        episodes.append(found)
    if TERMINATED in ends:
        why = f"{TERMINATED}, and no success: {failures} of {len(episodes)} episodes"
        fields.append(Field(_FAILED, "failure", "failure", "1", 1.0, why))
    for number, field in enumerate(fields):
        if field.role == "state" and field.unit == "1" and is_angle(field.short):
            largest = max(float(np.abs(values[field.name]).max()) for values in episodes)
            if largest > LARGEST and HEADING.fullmatch(field.plain):
                raise BadInputError(
                    f"{data.reference} has {field.name} up to {largest:.4g} without a unit: expected rad, as "
                    "a dataset's values are taken as they are: import the logs again with a `scale` of "
                    '0.0174533 there, or with the `unit` "rad" if it is in rad'
                )
            if largest <= LARGEST:
                why = f"its column, an angle up to {largest:.3g}"
                fields[number] = replace(field, unit="rad", why=why)
    return Logs(tuple(fields), tuple(episodes), {})


def _fields(column: Column) -> list[Field]:
    """Return a field for each value of a column."""
    names = column.names or tuple(f"{_ROLES[column.name][0]}{number}" for number in range(column.size))
    return [
        Field(f"{column.name} {name}", _ROLES[column.name], name, unit or "1", 1.0, "its column")
        for name, unit in zip(names, column.units, strict=True)
    ]


def _refuse_degrees(fields: Sequence[Field], reference: str) -> None:
    """Refuse headings in degrees, and commands in degrees beside a heading: nothing scales them."""
    headings = [field for field in fields if field.role != "command" and HEADING.fullmatch(field.plain)]
    turns = [field for field in fields if field.role == "command" and headings]
    if wrong := [f"{f.name} in {f.unit}" for f in (*headings, *turns) if f.unit in ("deg", "deg/s")]:
        raise BadInputError(
            f"{reference} has {', '.join(wrong)}: expected rad and rad/s, as a dataset's values are taken as "
            "they are: import the logs again with a `scale` of 0.0174533 there"
        )
