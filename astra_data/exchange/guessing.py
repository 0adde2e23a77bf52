"""What the fields of CSV logs are, guessed from their names and values; a person checks it."""

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.dataset.checkup.angles import ANGLE, LARGEST
from astra_data.exchange.csv_numbers import MOSTLY, plain_name, read_numbers, torn_files
from astra_data.exchange.cutting import RATE_TOLERANCE
from astra_data.exchange.field_names import (
    COMMAND,
    COMMANDED,
    ENDINGS,
    EPISODE,
    FORCE,
    GOAL,
    LENGTH,
    NAMES,
    PEDAL,
    PLACE_TO_GO,
    TIMES,
    UNCLEAR,
    UNITS,
    WEAK_FAILURE,
    Role,
)
from astra_data.exchange.log_files import csv_files
from astra_data.exchange.logs import Field, Logs


def guess(paths: Sequence[Path]) -> Logs:
    """Read CSV logs, and guess what their fields are.

    Args:
        paths: files with the same fields; a folder stands for the CSV files in it.

    Raises:
        BadInputError: there is no such file, it is no CSV, files differ, a time is not finite or a command
            mostly not, two fields come to the same name, there are no commands, no states or no episodes of
            two rows, or the rate is too far from a whole number for an import.
    """
    files = [file for path in paths for file in csv_files(path)]
    tables = {file: read_numbers(file, EPISODE) for file in files}
    first = next(iter(tables.values()))
    header = [name for name in first if all(name in table for table in tables.values())]
    for file, table in tables.items():
        if {*_filled(table), *_filled(first)} - (table.keys() & first.keys()):
            raise BadInputError(
                f"{file}: expected the fields of {files[0]}, {_filled(first)}: got {_filled(table)}"
            )
    joined = {name: np.concatenate([table[name] for table in tables.values()]) for name in header}
    guessed, every = [], list(tables.values())
    for name, values in joined.items():
        try:
            guessed.append(_goal(name, values, every) or _field(name, values))
        except BadInputError as error:
            lacking = next(file for file, table in tables.items() if not np.isfinite(table[name]).all())
            raise BadInputError(f"{lacking}: {error}") from None
    try:
        fields = _distinct(_times_apart(_places_apart(guessed, every), every))
    except BadInputError as error:
        raise BadInputError(f"{files[0]}: {error}") from None
    needed = [field.name for field in fields if field.role in ("state", "command")]
    gaps = {name: int((~np.isfinite(joined[name])).sum()) for name in needed}
    episodes = tuple(_episodes(fields, (_whole(table, needed) for table in tables.values())))
    if all(len(values) < 2 for episode in episodes for values in episode.values()):
        cut = [field.name for field in fields if field.role == "episode"]
        why = f"{' and '.join(cut)} changes in every row: leave it out" if cut else "record longer"
        raise BadInputError(f"{files[0]}: expected episodes of two rows or more, found none: {why}")
    found = Logs(fields, episodes, {name: gaps[name] for name in needed if gaps[name]}, torn_files(files))
    for role, example in (("command", "cmd_v"), ("state", "x")):
        if not found.of(role):  # type: ignore[arg-type]
            listed = ", ".join(f"{field.name} ({field.role})" for field in fields)
            raise BadInputError(
                f"{files[0]}: found no {role} among {listed}: name one in the header, such as {example}"
            )
    if abs(found.rate_error) > RATE_TOLERANCE:
        (time, *_) = found.of("time")
        raise BadInputError(
            f"{files[0]}: {time.name}: expected rows per second within {RATE_TOLERANCE:.0%} of a "
            f"whole number, as fps is one, got {found.recorded_rate:.4g}: correct its unit, or resample the "
            f"logs to {found.rate} rows per second"
        )
    return found


def _filled(table: dict[str, Floats]) -> list[str]:
    """Return the fields that hold numbers."""
    return [name for name, values in table.items() if np.isfinite(values).any()]


def _distinct(fields: list[Field]) -> tuple[Field, ...]:
    """Return the fields, with forces, or pedals and a wheel, as commands where there are no others.

    `u` is a speed where `v` is one too and something else is commanded.

    Raises:
        BadInputError: two states, or two commands, come to the same name.
    """
    named = {_without_unit(plain_name(field.name), ENDINGS)[0]: field for field in fields}
    commands = [field for field in fields if field.role == "command"]
    if len(commands) > 1 and "v" in named and (speed := named.get("u")) in commands:
        fields[fields.index(speed)] = replace(speed, role="state", short="u", why="a speed, like v")
    if not commands:
        fields = [
            replace(field, role="command", why=f"{why}, and no other command") if why else field
            for field, why in ((field, _may_command(field)) for field in fields)
        ]
    ends = set[Role]()
    # What is a failure for want of another one comes last.
    weak = [bool(WEAK_FAILURE.fullmatch(plain_name(field.name))) for field in fields]
    for number, field in sorted(enumerate(fields), key=lambda numbered: weak[numbered[0]]):
        if field.role in ("failure", "success", "reward"):
            if field.role in ends:
                why = f"a second {field.role}: combine both into one field"
                fields[number] = replace(field, role="left out", why=why)
            ends.add(field.role)
    seen: dict[str, str] = {}
    for field in fields:
        if field.role not in ("state", "command"):
            continue
        if (other := seen.setdefault(field.taken_for, field.name)) != field.name:
            raise BadInputError(
                f"{other} and {field.name} would both become {field.taken_for}: rename one, or leave it out"
            )
    return tuple(fields)


def _goal(name: str, values: Floats, tables: Sequence[dict[str, Floats]]) -> Field | None:
    """Return a field that its name calls a goal, and that has one value in each episode; None for others."""
    body, ending = _without_unit(plain_name(name), ENDINGS)
    found = GOAL.fullmatch(body)
    is_flag = bool(np.isin(values, (0, 1)).all())
    if found is None or (is_flag and not found["axis"]) or not _stays(name, tables):
        return None
    return _with_unit(name, "goal", body, ending, values)


def _places_apart(fields: Sequence[Field], tables: Sequence[dict[str, Floats]]) -> list[Field]:
    """Return the fields, with commanded places as goals where these stay and something else is commanded."""
    bodies = [_without_unit(plain_name(field.name), ENDINGS)[0] for field in fields]
    stay = {
        field.name
        for field, body in zip(fields, bodies, strict=True)
        if field.role == "command" and PLACE_TO_GO.fullmatch(body) and _stays(field.name, tables)
    }
    if not any(field.role == "command" or _may_command(field) for field in fields if field.name not in stay):
        return list(fields)
    return [
        replace(field, role="goal", why="constant in each episode") if field.name in stay else field
        for field in fields
    ]


def _may_command(field: Field) -> str:
    """Return why a state is a command where there is no other; nothing for what is none."""
    if field.role != "state":
        return ""
    return "a force" if FORCE.fullmatch(field.short) else "its name" if PEDAL.fullmatch(field.short) else ""


def _times_apart(fields: Sequence[Field], tables: Sequence[dict[str, Floats]]) -> list[Field]:
    """Return the fields, with a state that ends in a unit of time and rises as a time, if none is one."""
    found: list[Field] = []
    has_time = any(field.role == "time" for field in fields)
    for field in fields:
        _, ending = _without_unit(plain_name(field.name), TIMES)
        if ending is None or (field.role, field.unit) != ("state", "1") or not _rises(field.name, tables):
            found.append(field)
        elif has_time:
            found.append(replace(field, role="left out", why="a second time"))
        else:
            has_time = True
            why = "its ending, and it increases in every row"
            found.append(Field(field.name, "time", "time", ending, TIMES[ending], why))
    return found


def _stays(name: str, tables: Sequence[dict[str, Floats]]) -> bool:
    """Return whether a field has one value in each episode."""
    return not any(_steps(name, table).any() for table in tables)


def _rises(name: str, tables: Sequence[dict[str, Floats]]) -> bool:
    """Return whether a field grows from each row of an episode to the next."""
    return all((_steps(name, table) > 0).all() for table in tables)


def _steps(name: str, table: dict[str, Floats]) -> Floats:
    """Return the differences between the rows of each episode; nan where one is not finite."""
    values: Floats = np.where(np.isfinite(table[name]), table[name], np.nan)
    goes_on = np.ones(len(values) - 1, bool)
    for other, numbers in table.items():
        if EPISODE.fullmatch(plain_name(other)) and _is_whole(numbers):
            goes_on &= np.diff(numbers) == 0
    steps: Floats = np.diff(values)[goes_on]
    return steps


def _field(name: str, values: Floats) -> Field:
    plain = plain_name(name)
    left_out = partial(Field, name, "left out", plain, "1", 1.0)
    if not plain:
        return left_out("no letter a to z and no digit in its name")
    if not np.isfinite(values).any():
        return left_out("texts, dates or nothing: expected numbers, of a time in s, ms, us or ns")
    body, ending = _without_unit(plain, TIMES)
    if re.fullmatch(NAMES[0][1], body):
        _check_finite(name, "time", values)
        if (np.diff(values) > 0).mean() <= 0.9:
            return left_out("a time that does not rise")
        step = float(np.median(np.diff(values)))
        unit = ending or ("s" if step < 1 else "ms" if step < 1e3 else "us" if step < 1e6 else "ns")
        why = "its ending" if ending else f"steps of {step:g}"
        return Field(name, "time", "time", unit, TIMES[unit], why)
    if re.fullmatch(UNCLEAR, plain):
        return left_out("an end, but which? name it success or failed")
    body, ending = _without_unit(plain, ENDINGS)
    if ending in ("n", "v", "a") and re.fullmatch(f"{COMMANDED}|u", body):
        body, ending = plain, None  # an axis, as in cmd_v
    is_flag = bool(np.isin(values, (0, 1)).all())
    for role, pattern in NAMES[1:]:
        if re.fullmatch(pattern, plain) or re.fullmatch(pattern, body):
            if role in ("failure", "success") and not is_flag:
                continue
            if role == "episode" and not _is_whole(values):
                continue
            if WEAK_FAILURE.fullmatch(body) and not values.any():
                return left_out("never changes")
            if role != "command":
                return Field(name, role, role, "1", 1.0, "its name")
            if np.isfinite(values).mean() <= MOSTLY:
                _check_finite(name, "command", values)
            if np.ptp(values[np.isfinite(values)]) == 0:
                return left_out("never changes")
            short = COMMAND.sub("_", body).strip("_") or "command"
            return _with_unit(name, role, f"u{short}" if short[0].isdigit() else short, ending, values)
    finite = np.isfinite(values)
    if finite.mean() <= MOSTLY or np.ptp(values[finite]) == 0:
        return left_out("never changes" if finite.all() else f"no number in {(~finite).sum()} rows")
    if is_flag:
        return left_out("0 or 1: name it success or failed if it is an end")
    return _with_unit(name, "state", f"s{body}" if body[0].isdigit() else body, ending, values)


def _is_whole(values: Floats) -> bool:
    finite = values[np.isfinite(values)]
    return bool((finite == np.rint(finite)).all())


def _check_finite(name: str, role: Role, values: Floats) -> None:
    if wrong := int((~np.isfinite(values)).sum()):
        found = f"got none in {wrong} of {len(values)}: leave these rows out"
        raise BadInputError(f"{name}: expected a number in each row of a {role}, {found}")


def _without_unit(name: str, endings: Sequence[str] | dict[str, float]) -> tuple[str, str | None]:
    for ending in endings:
        if name.endswith(f"_{ending}") and len(name) > len(ending) + 1:
            return name.removesuffix(f"_{ending}"), ending
    return name, None


def _with_unit(name: str, role: Role, short: str, ending: str | None, values: Floats) -> Field:
    for known, unit, scale in UNITS:
        if ending == known:
            return Field(name, role, short, unit, scale, "its ending")
    if role in ("state", "goal") and ANGLE.fullmatch(short):
        if (largest := np.nanmax(np.abs(values))) > LARGEST:
            return Field(name, role, short, "rad", math.pi / 180, f"an angle up to {largest:.0f}: degrees")
        return Field(name, role, short, "rad", 1.0, "its name")
    if role in ("state", "goal") and LENGTH.fullmatch(short):
        return Field(name, role, short, "m", 1.0, "its name")
    return Field(name, role, short, "1", 1.0, "no unit in its name")


def _whole(table: dict[str, Floats], needed: Sequence[str]) -> dict[str, Floats]:
    """Return the rows of a file with a number in each of the fields `needed`."""
    kept = np.all([np.isfinite(table[name]) for name in needed], axis=0)
    return {name: values[kept] for name, values in table.items()} if needed else table


def _episodes(fields: Sequence[Field], tables: Iterable[dict[str, Floats]]) -> Iterator[dict[str, Floats]]:
    """Cut the files where the field of the episode changes, and scale their values."""
    for table in tables:
        values = {field.name: table[field.name] * field.scale for field in fields}
        cuts = {0, len(next(iter(values.values())))}
        for field in fields:
            if field.role == "episode":
                cuts |= set(1 + np.flatnonzero(np.diff(values[field.name])))
        for first, last in pairwise(sorted(cuts)):
            yield {name: column[first:last] for name, column in values.items()}
