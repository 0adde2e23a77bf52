"""What the fields of CSV logs are, guessed from their names and values; a person checks it."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.dataset.checkup.findings import ANGLE, LARGEST
from astra_data.io.cutting import RATE_TOLERANCE
from astra_data.io.importers.csv import torn_bytes
from astra_data.io.logs import (
    HEADING,
    MOSTLY,
    TURNED,
    Field,
    Logs,
    Role,
    csv_files,
    plain_name,
    read_numbers,
)
from astra_data.io.recording import Source

EPISODE = re.compile(
    r"(ep(isode)?|trial|drive|run|rollout|traj(ectory)?|flight|lap|session|bag)(_?(id|index|nr))?"
)
CLOCK = r"time|timestamps?|stamp|clock|utc|epoch|uptime|[mun]?secs?|seconds"
TIME, STAMP = re.compile(rf"t|(.+_)?({CLOCK})"), re.compile(rf"t|(.+_)?({CLOCK})(_.+|\d+)?")
"""Names of a log's time, and of times of topics too, such as stamp_motors; they never go back."""
COUNT = re.compile(r"(frame|row|step|seq|sample)(_?(id|index|nr))?|index|idx|id|(.+_)?n(ano)?secs?")
FLAGS: dict[Role, str] = {
    "failure": r"fail(ed|ure)?|fell|fall(en)?|tipped|toppled|overturned|capsized|jack_?knif(e|ed|ing)|"
    r"crash(ed)?|colli(sion|ded)|bump(ed|er)?|e_?stop|stuck|fault|terminated",
    "success": r"success|succeeded|(goal_)?reached|at_goal|arrived|delivered|docked|parked|solved",
}
UNCLEAR = re.compile(r"done|ended|truncated|timeout")
"""Ends of which the name does not tell whether they are successes, failures or neither."""
COMMANDED = "cmd|command|action|act|ctrl|control|setpoint|sp|desired|des|target|ref"
COMMAND = re.compile(rf"(.+_)?({COMMANDED})(_.+|\d+)?|u(_.+|\d+)?")
COMMAND_WORD = re.compile(rf"(^|_)({COMMANDED}|u)(_|(?=\d)|$)")
TORQUE, FORCE = (
    re.compile(rf"(.+_)?({words})(_.+|\d+)?") for words in ("tau|torque|effort|moment", "force|thrust")
)
PEDAL = re.compile(r"throttle|brake|steer(ing)?(_angle)?")
NO_PLACE = f"{TURNED}|quat|orient|vel|twist|linear|angular|speed|acc|rate|force|torque|moment"
PLACE = re.compile(
    rf"(?!.*({NO_PLACE}))(.+_)?(p|pos)?(?P<axis>[xyz]|east(ing)?|north(ing)?|up|alt(itude)?|depth)"
)
GPS = re.compile(r"(?P<stem>(.+_)?)(?P<axis>lat|lon|lng)(itude|gitude)?")
GOAL = re.compile(
    r"(?!.*(dist|bearing|_to_|_from_))(.+_)?(goal|destination|waypoint)"
    r"(?P<axis>_(x|y|z|yaw|heading|theta|psi|east|north|lat(itude)?|lon(gitude)?))?|"
    r"(target|ref|desired|des)_([xyz]|east|north)"
)
"""A goal where it is constant in each episode."""
METERS_PER_DEGREE = 111_195.0
"""Along a meridian of a sphere with Earth's mean radius, 6371 km."""
_DEGREE = math.pi / 180
_UNITS = (
    (
        "m/s",
        {"mm_s": 1e-3, "cm_s": 1e-2, "m_s": 1, "m_per_s": 1, "mps": 1, "mph": 0.44704, "knots": 0.514444},
    ),
    ("m/s", {"km_h": 1 / 3.6, "kmh": 1 / 3.6, "kph": 1 / 3.6}),
    (
        "rad/s",
        {
            "deg_s": _DEGREE,
            "deg_per_s": _DEGREE,
            "dps": _DEGREE,
            "rpm": math.pi / 30,
            "rad_s": 1,
            "rad_per_s": 1,
        },
    ),
    ("m/s²", {"m_s2": 1, "mps2": 1}),
    ("rad/s²", {"deg_s2": _DEGREE, "rad_s2": 1}),
    ("m", {"mm": 1e-3, "cm": 1e-2, "km": 1e3, "m": 1}),
    ("rad", {"deg": _DEGREE, "degrees": _DEGREE, "rad": 1}),
    *(("N m", {"nm": 1}), ("N", {"n": 1}), ("V", {"v": 1}), ("A", {"a": 1})),
)
UNITS = {ending: (unit, float(scale)) for unit, endings in _UNITS for ending, scale in endings.items()}
"""Endings of names, the unit that values are stored in, and the factor to it."""
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
MOST_END_ROWS = 10
"""Rows at the end of a log for which a flag that ends it may be set."""


def guess(paths: Sequence[Path]) -> Logs:
    """Read CSV logs, files with the same fields or folders of them, and guess what their fields are.

    Raises:
        BadInputError: there is no such file, it is no CSV, files differ, there are no commands, no states or
            no episodes of two rows, or the rate is too far from a whole number for an import.
    """
    files = [file for path in paths for file in csv_files(path)]
    sources = [Source(file, None, file) for file in files]
    tables = [read_numbers(source, EPISODE) for source in sources]
    filled = [[name for name, values in table.items() if np.isfinite(values).any()] for table in tables]
    for file, names, table in zip(files, filled, tables, strict=True):
        if {*names, *filled[0]} - (table.keys() & tables[0].keys()):
            raise BadInputError(f"{file}: expected the fields of {files[0]}, {filled[0]}: got {names}")
    raw = [episode for table in tables for episode in _episodes(table)]
    fields: list[Field] = []
    for name in (name for name in tables[0] if all(name in table for table in tables)):
        found = _field(name, [episode[name] for episode in raw])
        taken = any(
            found.taken_for == other.taken_for for other in fields if other.role in ("state", "command")
        )
        fields.append(replace(found, short=plain_name(name)) if taken else found)
    fields = _places(_roles(_times(fields, raw)), raw)
    needed = [field.name for field in fields if field.role in ("time", "state", "command")]
    gaps = {name: sum(int((~np.isfinite(episode[name])).sum()) for episode in raw) for name in needed}
    rows = [np.all([np.isfinite(episode[name]) for name in needed], axis=0) for episode in raw]
    episodes = tuple(
        {one.name: (episode[one.name] * one.scale + one.offset)[kept] for one in fields}
        for episode, kept in zip(raw, rows, strict=True)
        if kept.any()
    )
    cut_off = tuple(str(source.path) for source in sources if torn_bytes(source))
    logs = Logs(tuple(fields), episodes, {name: gap for name, gap in gaps.items() if gap}, cut_off)
    for role, example in (("command", "cmd_v"), ("state", "x")):
        if role not in [field.role for field in fields]:
            listed = ", ".join(f"{field.name} ({field.role})" for field in fields)
            raise BadInputError(
                f"{files[0]}: found no {role} among {listed}: name one in the header, such as {example}"
            )
    if all(kept.sum() < 2 for kept in rows):
        cut = [field.name for field in fields if field.role == "episode" or gaps.get(field.name)]
        why = f"look at {' and '.join(cut)}, which cut or lack rows" if cut else "record longer"
        raise BadInputError(f"{files[0]}: expected episodes of two rows or more, found none: {why}")
    if abs(logs.recorded_rate / logs.rate - 1) > RATE_TOLERANCE:
        raise BadInputError(
            f"{files[0]}: {logs.of('time')[0].name}: expected rows per second within {RATE_TOLERANCE:.0%} "
            f"of a whole number, as fps is one, got {logs.recorded_rate:.4g}: correct its unit or resample"
        )
    return logs


def _episodes(table: dict[str, Floats]) -> list[dict[str, Floats]]:
    """Cut a file where a field of the episode changes."""
    cuts = {0, len(next(iter(table.values())))}
    for name, values in table.items():
        if EPISODE.fullmatch(plain_name(name)) and _is_whole(values):
            cuts |= set((1 + np.flatnonzero(np.diff(values))).tolist())
    return [{name: values[a:b] for name, values in table.items()} for a, b in pairwise(sorted(cuts))]


def _field(name: str, series: Sequence[Floats]) -> Field:
    """Return what a field is by itself, of its values (T,) in each episode."""
    plain, values = plain_name(name), np.concatenate(series)
    finite = np.isfinite(values)
    steps = np.concatenate([np.diff(one[np.isfinite(one)]) for one in series])
    clock, time_unit = _without_unit(plain, TIMES)
    body, ending = _without_unit(plain, UNITS)
    if ending in ("n", "v", "a") and re.fullmatch(f"{COMMANDED}|u", body):
        body, ending = plain, None  # an axis, as in cmd_v
    is_flag, is_constant = (
        bool(np.isin(values, (0, 1)).all()),
        not np.ptp(values[finite]) if finite.any() else True,
    )
    role: Role = "left out"
    why = "its name"
    if not plain or not finite.any():
        why = (
            "texts, dates or nothing: expected numbers, of a time in s, ms, us or ns"
            if plain
            else "no letter a to z"
        )
    elif (STAMP.fullmatch(clock) or time_unit) and (steps >= 0).all() and (steps > 0).any():
        step = float(np.median(steps))
        unit = time_unit or ("s" if step < 1 else "ms" if step < 1e3 else "us" if step < 1e6 else "ns")
        why = "its ending, and it never goes back" if time_unit else f"steps of {step:g}"
        return Field(name, "time", plain, unit, TIMES[unit], why)
    elif TIME.fullmatch(clock):
        why = "a time that does not rise"
    elif UNCLEAR.fullmatch(plain):
        why = "an end, but which? name it success or failed"
    elif EPISODE.fullmatch(plain) and _is_whole(values):
        role = "episode"
    elif COUNT.fullmatch(plain):
        pass
    elif is_flag and (flag := next((flag for flag in FLAGS if re.fullmatch(FLAGS[flag], plain)), None)):
        role = flag
    elif plain == "reward":
        role = "reward"
    elif (
        (goal := GOAL.fullmatch(body))
        and (goal["axis"] or not is_flag)
        and not any(np.ptp(one) for one in series)
    ):
        return _with_unit(name, "goal", body, ending, values)
    elif is_constant:
        why = "never changes"
    elif COMMAND.fullmatch(body):
        return _with_unit(
            name, "command", COMMAND_WORD.sub("_", body).strip("_") or "command", ending, values
        )
    elif is_flag:
        flags = [one for one in series if one.any()]
        why = "0 or 1: name it success or failed if it is an end"
        if all(one[-1] and one[np.argmax(one > 0) :].all() and one.sum() <= MOST_END_ROWS for one in flags):
            role, why = (
                "failure",
                f"0 or 1, and it ends all {len(flags)} of {len(series)} episodes that have a 1 (CHECK)",
            )
    elif finite.mean() <= MOSTLY:
        why = f"no number in {(~finite).sum()} rows"
    else:
        return _with_unit(name, "state", body, ending, values)
    return Field(name, role, plain, why=why)


def _with_unit(name: str, role: Role, short: str, ending: str | None, values: Floats) -> Field:
    """Return a field with its unit, by the ending of its name, or else by what it is called."""
    short = f"{'u' if role == 'command' else 's'}{short}" if short[0].isdigit() else short
    if ending is not None:
        return Field(name, role, short, *UNITS[ending], "its ending")
    unit, scale, why = "1", 1.0, "its name"
    if TORQUE.fullmatch(short) or FORCE.fullmatch(short):
        unit = "N m" if TORQUE.fullmatch(short) else "N"
    elif role != "command" and (ANGLE.fullmatch(short) or HEADING.fullmatch(short)):
        largest, unit = np.nanmax(np.abs(values)), "rad"
        scale, why = (
            (_DEGREE, f"an angle up to {largest:.0f}: degrees") if largest > LARGEST else (scale, why)
        )
    elif role != "command" and PLACE.fullmatch(short):
        unit = "m"
    return Field(name, role, short, unit, scale, why if unit != "1" else "no unit in its name")


def _times(fields: Sequence[Field], episodes: Sequence[dict[str, Floats]]) -> list[Field]:
    """Return the fields with one time, that of the log: the others are times of topics."""

    def rank(field: Field) -> tuple[bool, bool]:
        steps = np.concatenate([np.diff(episode[field.name]) for episode in episodes])
        return bool((steps > 0).mean() <= MOSTLY), not TIME.fullmatch(_without_unit(field.short, TIMES)[0])

    times = sorted((field for field in fields if field.role == "time"), key=rank)
    chosen = [field for field in times[:1] if not rank(field)[0]]
    why = f"a time beside {chosen[0].name}" if chosen else "a time that stands still in some rows"
    return [
        Field(f.name, "left out", f.short, why=why) if f in times and f not in chosen else f for f in fields
    ]


def _roles(fields: Sequence[Field]) -> list[Field]:
    """Return the fields, with forces and pedals as commands if there are no others, one of each outcome."""
    is_commanded = any(field.role == "command" for field in fields)
    found: list[Field] = []
    for field in sorted(fields, key=lambda field: field.why.endswith("(CHECK)")):
        if field.role in ("failure", "success", "reward") and field.role in [one.role for one in found]:
            field = replace(field, role="left out", why=f"a second {field.role}: combine both into one field")
        acts = any(pattern.fullmatch(field.short) for pattern in (TORQUE, FORCE, PEDAL))
        if acts and field.role == "state" and not is_commanded:
            field = replace(field, role="command", why=f"{field.why}, and no other command")
        found.append(field)
    by_name = {field.name: field for field in found}
    return [by_name[field.name] for field in fields]


def _places(fields: Sequence[Field], episodes: Sequence[dict[str, Floats]]) -> list[Field]:
    """Return the fields, with latitude and longitude in m, and with offsets where float32 loses steps."""
    gps = {field.short: found for field in fields if (found := GPS.fullmatch(field.short))}
    latitudes = {found["stem"]: short for short, found in gps.items() if found["axis"] == "lat"}
    pairs = {found["stem"] for found in gps.values() if found["axis"] != "lat"} & latitudes.keys()
    offsets: dict[str, float] = {}
    placed: dict[str, Field] = {}
    for field in sorted(fields, key=lambda field: field.role == "goal"):  # goals take the offsets of states
        values = np.concatenate([episode[field.name] for episode in episodes])
        if field.role not in ("state", "goal") or not np.isfinite(values).any():
            continue
        first, largest = float(values[np.isfinite(values)][0]), float(np.nanmax(np.abs(values)))
        place, at = PLACE.fullmatch(field.short), gps.get(field.short)
        if at and at["stem"] in pairs:
            latitude = next(one.name for one in fields if one.short == latitudes[at["stem"]])
            degrees = 1e-7 if largest > 360 else 1.0
            north = math.radians(float(np.nanmean(episodes[0][latitude])) * degrees)
            scale = degrees * METERS_PER_DEGREE * (1.0 if at["axis"] == "lat" else math.cos(north))
            why, offset = "degrees, to m from the first row", offsets.setdefault(at["axis"], -first * scale)
            placed[field.name] = replace(field, unit="m", scale=scale, offset=offset, why=why)
        elif place and field.unit == "m":
            steps = (
                np.abs(np.concatenate([np.diff(episode[field.name]) for episode in episodes])) * field.scale
            )
            step = float(np.median(steps[steps > 0])) if (steps > 0).any() else math.inf
            if field.role == "state" and np.spacing(np.float32(largest * field.scale)) > step / 100:
                offsets[place["axis"]] = -float(round(first * field.scale))
            if offset := offsets.get(place["axis"], 0.0):
                why = f"{field.why}; an offset, as float32 cannot hold its steps"
                placed[field.name] = replace(field, offset=offset, why=why)
    return [placed.get(field.name, field) for field in fields]


def _is_whole(values: Floats) -> bool:
    finite = values[np.isfinite(values)]
    return bool((finite == np.rint(finite)).all())


def _without_unit(name: str, endings: Iterable[str]) -> tuple[str, str | None]:
    for ending in sorted(endings, key=len, reverse=True):
        if name.endswith(f"_{ending}") and len(name) > len(ending) + 1:
            return name.removesuffix(f"_{ending}"), ending
    return name, None
