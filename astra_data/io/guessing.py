"""What the fields of a new robot's logs are, guessed from their names and values; a person checks it."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import batched, pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from astra_data.core.arrays import Bools, Floats, Ints
from astra_data.core.errors import BadInputError
from astra_data.dataset.checkup import ANGLE, LARGEST, is_angle
from astra_data.dataset.columns import ACTION, GOAL, STATE, SUCCESS, TERMINATED, TIMESTAMP
from astra_data.dataset.reader import Dataset, refuse_folders
from astra_data.io.cutting import RATE_TOLERANCE
from astra_data.io.importers.csv import SUFFIXES, decimal_comma, is_number, numbers_of, texts_of
from astra_data.io.recording import Source, foreign, refuse_broken_links, refuse_dataset

Role = Literal["time", "episode", "state", "command", "goal", "failure", "success", "reward", "left out"]
TURNED = "heading|yaw|theta|psi|compass|course|cog|azimuth|hdg"
HEADING = re.compile(rf"(.+_)?({TURNED})")
EPISODE = re.compile(r"(ep(isode)?|trial|drive|run|rollout|traj(ectory)?|flight|lap|session|bag)(_?(id|index|nr))?")
CLOCK = r"t|(.+_)?(time|timestamps?|stamp|clock|utc|epoch|uptime|[mun]?secs?|seconds)"
TIME, STAMP = re.compile(CLOCK), re.compile(rf"{CLOCK}(_.+|\d+)?")
"""Names of a log's time, and of times of topics too, such as stamp_motors; they never go back."""
COUNT = re.compile(r"(frame|row|step|seq|sample)(_?(id|index|nr))?|index|idx|id|(.+_)?n(ano)?secs?")
FLAGS: dict[Role, str] = {
    "failure": r"fail(ed|ure)?|fell|fall(en)?|tipped|toppled|overturned|capsized|jack_?knif(e|ed|ing)|"
    r"crash(ed)?|colli(sion|ded)|bump(ed|er)?|e_?stop|stuck|fault|terminated",
    "success": r"success|succeeded|(goal_)?reached|at_goal|arrived|delivered|docked|parked|solved",
}
UNCLEAR = re.compile(r"done|ended|truncated|timeout")  # successes, failures or neither: the name does not tell
COMMANDED = "cmd|command|action|act|ctrl|control|setpoint|sp|desired|des|target|ref"
COMMAND_WORD = re.compile(rf"(^|_)({COMMANDED}|u)(_|(?=\d)|$)")
COMMAND, TORQUE, FORCE = (
    re.compile(rf"{words}(_.+|\d+)?")
    for words in (rf"((.+_)?({COMMANDED})|u)", "(.+_)?(tau|torque|effort|moment)", "(.+_)?(force|thrust)")
)
ACTING = (TORQUE, FORCE, re.compile(r"throttle|brake|(steer(ing)?|rudder|aileron|elevator)(_angle)?"))
_NOT = f"{TURNED}|quat|orient|vel|twist|linear|angular|speed|acc|rate|force|torque|moment"
PLACE = re.compile(rf"(?!.*({_NOT})|(.+_)?q_)(.+_)?(p|pos)?(?P<axis>[xyz]|east(ing)?|north(ing)?|up|alt(itude)?|depth)")
GPS = re.compile(r"(?P<stem>(.+_)?)(?P<axis>lat|lon|lng)(itude|gitude)?")
GAP_STEPS = 5  # periods without a row after which another episode begins
GOAL_NAME = re.compile(
    r"(?!.*(dist|bearing|_to_|_from_))(.+_)?(goal|destination|waypoint)"
    r"(?P<axis>_(x|y|z|yaw|heading|theta|psi|east|north|lat(itude)?|lon(gitude)?))?|"
    r"(target|ref|desired|des)_([xyz]|east|north)"
)  # a goal where it is constant in each episode
METERS_PER_DEGREE = 111_195.0  # along a meridian of a sphere with Earth's mean radius, 6371 km
_DEGREE = math.pi / 180
_UNITS = {
    "m/s": "mm_s 1e-3 cm_s 1e-2 m_s 1 m_per_s 1 mps 1 mph 0.44704 knots 0.514444 "
    f"km_h {1 / 3.6} kmh {1 / 3.6} kph {1 / 3.6}",
    "rad/s": f"deg_s {_DEGREE} deg_per_s {_DEGREE} dps {_DEGREE} rpm {math.pi / 30} rad_s 1 rad_per_s 1",
    "m/s²": "m_s2 1 mps2 1",
    "rad/s²": f"deg_s2 {_DEGREE} rad_s2 1",
    "m": "mm 1e-3 cm 1e-2 km 1e3 m 1",
    "rad": f"deg {_DEGREE} degrees {_DEGREE} rad 1",
} | {"N m": "nm 1", "N": "n 1", "V": "v 1", "A": "a 1", "1": "pct 1e-2 percent 1e-2"}
UNITS = {end: (unit, float(scale)) for unit, ends in _UNITS.items() for end, scale in batched(ends.split(), 2)}
"""Endings of names, the unit that values are stored in, and the factor to it."""
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
MOST_END_ROWS = 10  # rows at the end of a log for which a flag that ends it may be set
RATE_HZ = 10.0  # assumed rate of logs without a time
MOSTLY = 0.9  # share of a field's rows with a number above which the others are faults
_EVEN = 0.005  # relative error of a rate that counts as a whole number


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
        return plain_name(self.short) or self.short

    @property
    def taken_for(self) -> str:
        """Its role, with the name of a state or command."""
        return f"{self.role} {self.short}" if self.role in ("state", "command") else self.role


@dataclass(frozen=True)
class Logs:
    """Logs and what their fields are, in the order of the logs."""

    fields: tuple[Field, ...]
    episodes: tuple[dict[str, Floats], ...]
    """Scaled values (T,) of each by a field's name, in rows whose states and commands are numbers."""
    left_out: dict[str, int]  # how many rows lack a number, by the name of the field
    cut_off: tuple[str, ...] = ()  # files whose last line is cut off and left out

    def of(self, role: Role) -> tuple[Field, ...]:
        """Return the fields with a role."""
        return tuple(field for field in self.fields if field.role == role)

    def values(self, fields: Sequence[Field]) -> list[Floats]:
        """Return the values (T, len(fields)) of each episode."""
        return [np.stack([episode[field.name] for field in fields], axis=-1) for episode in self.episodes]

    @property
    def recorded_rate(self) -> float:
        """Rows per second without gaps and repeated rows; `RATE_HZ` where there is no time, 0 where it stands still."""
        steps = np.concatenate([_steps(self.episodes, field) for field in self.of("time")] or [np.array([1 / RATE_HZ])])
        steps = steps[steps > 0]
        return 1 / float(steps[steps <= 1.5 * np.median(steps)].mean()) if len(steps) else 0.0

    @property
    def rate(self) -> int:
        """The whole rate nearest to the recorded one."""
        return max(1, round(self.recorded_rate))

    @property
    def uneven(self) -> str:
        """Why the rate is not known to be whole, and what to do; empty where it is one within `_EVEN`."""
        if not self.of("time"):
            return f"the logs have no time in numbers: {self.rate} rows per second are assumed; set fps, TIMESTEP_S"
        error = self.recorded_rate / self.rate - 1
        off = f"{abs(error):.1%} too {'long' if error > 0 else 'short'}; resample them to {self.rate} rows per second"
        warning = f"the logs have {self.recorded_rate:.4g} rows per second, not a whole number: TIMESTEP_S is {off}"
        return warning if abs(error) >= _EVEN else ""

    @property
    def still(self) -> str:
        """Which commands never change, and the consequence; empty where all do."""
        given = np.concatenate(self.values(self.of("command"))).T
        named = [f"{one.short} is {v[0]:g}" for one, v in zip(self.of("command"), given, strict=True) if not np.ptp(v)]
        what = "it does" if len(named) == 1 else "they do"
        return f"{' and '.join(named)} in all rows: no simulator can learn what {what}" if named else ""


def guess(paths: Sequence[Path]) -> Logs:
    """Read CSV logs, files with the same fields or folders of them, and guess what their fields are."""
    sources = [Source(file, None, file) for path in paths for file in csv_files(path)]
    tables, torn = zip(*map(read_numbers, sources), strict=True)
    first, filled = sources[0].path, [[name for name, v in one.items() if np.isfinite(v).any()] for one in tables]
    for source, table, names in zip(sources, tables, filled, strict=True):
        if {*names, *filled[0]} - (table.keys() & tables[0].keys()):
            raise BadInputError(f"{source.path}: expected the fields of {first}, {filled[0]}: got {names}")
    raw = [episode for table in tables for episode in _episodes(table)]
    fields: list[Field] = []
    for name in (name for name in tables[0] if all(name in table for table in tables)):
        found = _field(name, [episode[name] for episode in raw])
        is_taken = found.role in ("state", "command") and found.taken_for in [one.taken_for for one in fields]
        fields.append(replace(found, short=plain_name(name)) if is_taken else found)
    fields = _places(_roles(_times(first, fields, raw)), raw)
    for time in (field for field in fields if field.role == "time"):
        _check_rates(sources, [np.diff(table[time.name]) * time.scale for table in tables])
        steps = _steps(raw, time)
        longest = GAP_STEPS * np.median(steps[steps > 0])
        begins = [1 + np.flatnonzero((of < 0) | (of > longest)) for of in (np.diff(one[time.name]) for one in raw)]
        raw = [part for one, rows in zip(raw, begins, strict=True) for part in _cut(one, rows)]
    for role, example in (("command", "cmd_v"), ("state", "x")):
        if role not in [field.role for field in fields]:
            listed = ", ".join(f"{field.name} ({field.role})" for field in fields)
            raise BadInputError(f"{first}: found no {role} among {listed}: name one in the header, such as {example}")
    needed = [field.name for field in fields if field.role in ("time", "state", "command")]
    gaps = {name: gap for name in needed if (gap := sum(int((~np.isfinite(one[name])).sum()) for one in raw))}
    runs = [_runs(np.isfinite([one[name] for name in needed])) for one in raw]
    if not any(runs):
        cut = [field.name for field in fields if field.role == "episode" or field.name in gaps]
        why = f"look at {' and '.join(cut)}, which cut or lack rows" if cut else "record longer"
        raise BadInputError(f"{first}: expected episodes of two rows or more, found none: {why}")
    parts = [(one, run) for one, of in zip(raw, runs, strict=True) for run in of]
    scaled = [{f.name: one[f.name][run] * f.scale + f.offset for f in fields} for one, run in parts]
    cut_off = [str(source.path) for source, is_torn in zip(sources, torn, strict=True) if is_torn]
    logs = Logs(tuple(fields), tuple(scaled), gaps, tuple(cut_off))
    if abs(logs.recorded_rate / logs.rate - 1) > RATE_TOLERANCE:
        wanted = f"expected rows per second within {RATE_TOLERANCE:.0%} of a whole number, as fps is one"
        got = f"got {logs.recorded_rate:.4g}: correct its unit or resample"
        raise BadInputError(f"{first}: {logs.of('time')[0].name}: {wanted}, {got}")
    return logs


def _check_rates(sources: Sequence[Source], steps_s: Sequence[Floats]) -> None:
    """Refuse a file whose rows come at another rate than those of most; `steps_s` (T - 1,) are of each file."""
    rates = [1 / float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0 for steps in steps_s]
    usual = sorted(rates)[len(rates) // 2]
    for source, rate in zip(sources, rates, strict=True):
        if rate and usual and abs(rate / usual - 1) > RATE_TOLERANCE:
            advice = f"as in other files, got {rate:.4g}: leave it out, or resample it"
            raise BadInputError(f"{source.path}: expected {usual:.4g} rows per second, {advice}")


def _episodes(table: dict[str, Floats]) -> list[dict[str, Floats]]:
    """Cut a file where a field of the episode changes."""
    episode = [v for name, v in table.items() if EPISODE.fullmatch(plain_name(name)) and _is_whole(v)]
    return _cut(table, np.concatenate([1 + np.flatnonzero(np.diff(values)) for values in [*episode, np.zeros(1)]]))


def _cut(table: dict[str, Floats], begins: Ints) -> list[dict[str, Floats]]:
    """Cut rows where others begin."""
    cuts = sorted({0, len(next(iter(table.values()))), *begins.tolist()})
    return [{name: values[a:b] for name, values in table.items()} for a, b in pairwise(cuts)]


def _runs(known: Bools) -> list[Ints]:
    """Return the rows of each run of two or more in which all values (N, T) are `known`."""
    rows = np.flatnonzero(known.all(axis=0))
    return [run for run in np.split(rows, 1 + np.flatnonzero(np.diff(rows) > 1)) if len(run) > 1]


def _field(name: str, series: Sequence[Floats]) -> Field:
    """Return what a field is by itself, of its values (T,) in each episode: the first of these that it can be."""
    plain, values = plain_name(name), np.concatenate(series)
    finite = values[np.isfinite(values)]
    steps = np.concatenate([np.diff(one[np.isfinite(one)]) for one in series])
    step = float(np.median(steps)) if len(steps) else 0.0
    clock, time_unit = _without_unit(plain, TIMES)
    body, ending = _without_unit(plain, UNITS)
    if ending in ("n", "v", "a") and re.fullmatch(f"{COMMANDED}|u", body):
        body, ending = plain, None  # an axis, as in cmd_v
    is_flag, flags = bool(np.isin(values, (0, 1)).all()), [one for one in series if one.any()]
    ends = all(one[-1] and one[np.argmax(one > 0) :].all() and one.sum() <= MOST_END_ROWS for one in flags)
    goal = GOAL_NAME.fullmatch(body)
    is_goal = goal and (goal["axis"] or not is_flag) and not any(map(np.ptp, series))
    falls = bool((steps < 0).any())
    is_rising = (steps > 0).mean() > MOSTLY if falls else (steps > 0).any()
    rises = (STAMP.fullmatch(clock) or time_unit) and len(steps) and is_rising
    named, lacking = "its name", len(values) - len(finite)
    ended = f"all {len(flags)} of {len(series)} episodes that have a 1"
    roles: list[tuple[object, Role, str]] = [
        (not plain, "left out", "no letter a to z"),
        (not finite.size, "left out", "texts, dates or nothing: expected numbers, of a time in s, ms, us or ns"),
        (rises and falls, "time", "it goes back, where episodes begin (CHECK)"),
        (rises, "time", "its ending, and it never goes back" if time_unit else f"steps of {step:g}"),
        (TIME.fullmatch(clock), "left out", _FALLS),
        (UNCLEAR.fullmatch(plain), "left out", "an end, but which? name it success or failed"),
        (EPISODE.fullmatch(plain) and _is_whole(values), "episode", named),
        (COUNT.fullmatch(plain), "left out", named),
        *((is_flag and re.fullmatch(words, plain), flag, named) for flag, words in FLAGS.items()),
        (plain == "reward", "reward", named),
        (is_goal, "goal", ""),
        (not np.ptp(finite) if finite.size else True, "left out", "never changes"),
        (COMMAND.fullmatch(body), "command", ""),
        (is_flag and ends, "failure", f"0 or 1, and it ends {ended} (CHECK)"),
        (is_flag, "left out", "0 or 1: name it success or failed if it is an end"),
        (lacking >= (1 - MOSTLY) * len(values), "left out", f"no number in {lacking} rows"),
    ]
    role, why = next(((role, why) for holds, role, why in roles if holds), ("state", ""))
    if role == "time":
        unit = time_unit or ("s" if step < 1 else "ms" if step < 1e3 else "us" if step < 1e6 else "ns")
        return Field(name, role, plain, unit, TIMES[unit], why)
    if why:
        return Field(name, role, plain, why=why)
    short = COMMAND_WORD.sub("_", body).strip("_") or "command" if role == "command" else body
    short = f"{'u' if role == 'command' else 's'}{short}" if short[0].isdigit() else short
    if ending is not None:
        return Field(name, role, short, *UNITS[ending], "its ending")
    unit, largest, is_state = "1", np.abs(finite).max(), role != "command"
    if TORQUE.fullmatch(short) or FORCE.fullmatch(short):
        unit = "N m" if TORQUE.fullmatch(short) else "N"
    elif is_state and (ANGLE.fullmatch(short) or HEADING.fullmatch(short)):
        if largest > LARGEST:
            return Field(name, role, short, "rad", _DEGREE, f"an angle up to {largest:.0f}: degrees")
        unit = "rad"
    elif is_state and PLACE.fullmatch(short):
        unit = "m"
    return Field(name, role, short, unit, why=named if unit != "1" else "no unit in its name")


_FALLS = "a time that does not rise"


def _times(place: Path, fields: Sequence[Field], episodes: Sequence[dict[str, Floats]]) -> list[Field]:
    """Return the fields with one time, that of the log: the others are times of topics."""
    rising = [f for f in fields if f.role == "time" and (_steps(episodes, f) > 0).mean() > MOSTLY]
    chosen = sorted(rising, key=lambda field: not TIME.fullmatch(_without_unit(field.short, TIMES)[0]))[:1]
    for field in fields:
        if not chosen and (field.role == "time" or field.why == _FALLS):
            steps = np.concatenate([np.diff(one[field.name]) for one in episodes])
            raise BadInputError(
                f"{place}: {field.name}: expected a time that rises from row to row, got {(steps == 0).sum()} rows in "
                f"which it stands still and {(steps < 0).sum()} in which it goes back: remove copies and sort the rows"
            )
    why = f"a time beside {chosen[0].name}" if chosen else "a time that stands still in some rows"
    topics = [field for field in fields if field.role == "time" and field not in chosen]
    return [Field(field.name, "left out", field.short, why=why) if field in topics else field for field in fields]


def _roles(fields: Sequence[Field]) -> list[Field]:
    """Return the fields, with forces and pedals as commands if there are no others, one of each outcome."""
    is_commanded, found = any(field.role == "command" for field in fields), {field.name: field for field in fields}
    seen: set[Role] = set()
    for field in sorted(fields, key=lambda field: field.why.endswith("(CHECK)")):
        if field.role in seen & {"failure", "success", "reward"}:
            found[field.name] = replace(field, role="left out", why=f"a second {field.role}: combine both into one")
        elif field.role == "state" and not is_commanded and any(one.fullmatch(field.short) for one in ACTING):
            found[field.name] = replace(field, role="command", why=f"{field.why}, and no other command")
        seen.add(field.role)
    return [*found.values()]


def _places(fields: Sequence[Field], episodes: Sequence[dict[str, Floats]]) -> list[Field]:
    """Return the fields, with latitude and longitude in m, and with offsets where float32 loses steps."""
    gps = {field.name: found for field in fields if (found := GPS.fullmatch(field.short))}
    known = {name: [one[name] for one in episodes if np.isfinite(one[name]).any()] for name in gps}
    latitudes = {found["stem"]: known[name][0] for name, found in gps.items() if found["axis"] == "lat" and known[name]}
    pairs = {found["stem"] for found in gps.values() if found["axis"] != "lat"} & latitudes.keys()
    offsets: dict[str, float] = {}
    placed = {field.name: field for field in fields}
    for field in sorted(fields, key=lambda field: field.role == "goal"):  # goals take the offsets of states
        if field.role not in ("state", "goal"):
            continue
        values = np.concatenate([episode[field.name] for episode in episodes]) * field.scale
        first, largest = float(values[np.isfinite(values)][0]), float(np.nanmax(np.abs(values)))
        place, at = PLACE.fullmatch(field.short), gps.get(field.name)
        if at and at["stem"] in pairs:
            scale = METERS_PER_DEGREE * (degrees := 1e-7 if largest > 360 else 1.0)
            if at["axis"] != "lat":
                scale *= math.cos(math.radians(float(np.nanmean(latitudes[at["stem"]])) * degrees))
            why, offset = "degrees, to m from the first row", offsets.setdefault(at["axis"], -first * scale)
            placed[field.name] = replace(field, unit="m", scale=scale, offset=offset, why=why)
        elif place and field.unit == "m":
            steps = np.abs(_steps(episodes, field)) * field.scale
            step = float(np.median(steps[steps > 0])) if (steps > 0).any() else math.inf
            if field.role == "state" and np.spacing(np.float32(largest)) > step / 100:
                offsets[place["axis"]] = -float(round(first))
            if offset := offsets.get(place["axis"], 0.0):
                why = f"{field.why}; an offset, as float32 cannot hold its steps"
                placed[field.name] = replace(field, offset=offset, why=why)
    return [*placed.values()]


def _steps(episodes: Sequence[dict[str, Floats]], field: Field) -> Floats:
    return np.concatenate([np.diff(episode[field.name]) for episode in episodes])


def _is_whole(values: Floats) -> bool:
    finite = values[np.isfinite(values)]
    return bool((finite == np.rint(finite)).all())


def _without_unit(name: str, endings: Iterable[str]) -> tuple[str, str | None]:
    found = re.fullmatch(rf"(.+?)_({'|'.join(endings)})", name)
    return (found[1], found[2]) if found else (name, None)


def csv_files(place: Path) -> list[Path]:
    """Return the CSV files in a folder, or the one that `place` is; raise BadInputError if there is none."""
    inside = sorted(place.iterdir()) if place.is_dir() else [place]
    found = [path for path in inside if path.suffix.lower() in SUFFIXES]
    refuse_broken_links(found)
    if not found:
        refuse_folders(place)
        refuse_dataset(place)
        hint = foreign([str(path) for path in inside])
        raise BadInputError(
            f"{place}: {hint}{'; ' if hint else ''}expected files that end in {' or '.join(SUFFIXES)}, or a dataset: "
            "make one of other recordings with `astra-data import LOGS --mapping FILE` (`astra-data recipes list` "
            "shows mappings, such as ros2_base), then name it: --from NAME"
        )
    return found


def plain_name(name: str) -> str:
    """Return a field's name in small letters, digits and single underscores; ° is deg, % pct, ² and ^2 are 2."""
    spelled = re.sub(r"(?<=[a-z]{2})(?=[A-Z])", "_", name).lower().replace("°", " deg ").replace("%", " pct ")
    return re.sub(r"[^a-z0-9]+", "_", spelled.replace("²", "2").replace("^", "")).strip("_")


def read_numbers(source: Source) -> tuple[dict[str, Floats], bool]:
    """Return the fields (T,) of a CSV file as numbers, and whether its last row is cut off.

    Texts that name episodes become a number each; other texts and dates are NaN.
    """
    columns, is_torn, _ = texts_of(source)
    numbers: dict[str, Floats] = {}
    for name, cells in columns.items():
        if len(cells) < 2:
            raise BadInputError(f"{source}: expected two rows or more below its header, got {len(cells)}: leave it out")
        texts = cells.to_pylist()
        words = [text for text in texts if text and not is_number(text)]
        is_number_field = len(words) < (1 - MOSTLY) * len(texts) or decimal_comma(words[0])  # which is refused
        values = numbers_of(cells, source, name) if is_number_field else np.empty(0)
        if len(values) and values.ndim == 1:
            numbers[name] = values.astype(float)
        elif EPISODE.fullmatch(plain_name(name)) and not cells.null_count:
            numbers[name] = np.unique(texts, return_inverse=True)[1].astype(float)
        else:
            numbers[name] = np.full(len(texts), np.nan)
    if not any(np.isfinite(values).any() for values in numbers.values()):
        raise BadInputError(f"{source}: expected rows of numbers below a header")
    return numbers, is_torn


def logs_of(data: Dataset) -> Logs:
    """Return the episodes of `data` as logs: its states, commands and goals by their own names, and failures."""
    columns = data.specs([STATE, ACTION, *([GOAL] if GOAL in data.features else [])])
    fields: list[Field] = []
    roles: tuple[Role, ...] = ("state", "command", "goal")
    for column, role in zip(columns, roles[: len(columns)], strict=True):
        names = column.names or [f"{role[0]}{at}" for at in range(column.size)]
        for name, unit in zip(names, column.units, strict=True):
            fields.append(Field(f"{column.name} {name}", role, name, unit or "1", why="its column"))
    episodes = []
    ends = [name for name in (TERMINATED, SUCCESS) if name in data.features]
    for episode in data.episodes([*(column.name for column in columns), *ends]):
        values = np.column_stack([episode.columns[column.name] for column in columns]).astype(float)
        found = {field.name: series for field, series in zip(fields, values.T, strict=True)}
        success = episode.columns.get(SUCCESS, np.zeros(len(values), bool))
        found["failed"] = (episode.columns.get(TERMINATED, success) & ~success).astype(float)
        episodes.append(found | {TIMESTAMP: np.arange(len(values)) / data.info["fps"]})
    headings = [field for field in fields if field.role != "command" and HEADING.fullmatch(field.plain)]
    wrong = [one for one in fields if headings and (one in headings or one.role == "command") and "deg" in one.unit]
    for number, field in enumerate(fields):
        if field.role == "state" and field.unit == "1" and is_angle(field.short):
            is_small = max(float(np.abs(values[field.name]).max()) for values in episodes) <= LARGEST
            wrong += [field] if field in headings and not is_small else []
            fields[number] = replace(field, unit="rad" if is_small else "1")
    if wrong:
        raise BadInputError(
            f"{data.reference} has {', '.join(f'{field.name} in {field.unit}' for field in wrong)}: expected rad and "
            "rad/s, as a dataset's values are taken as they are: import the logs again with a `scale` of 0.0174533 "
            "there (or with the `unit` rad if so)"
        )
    failures = sum(bool(one["failed"].any()) for one in episodes)
    why = f"terminated, and no success: {failures} of {len(episodes)} episodes"
    time = Field(TIMESTAMP, "time", "time", "s", why=f"{data.info['fps']} rows a second")
    return Logs((time, *fields, Field("failed", "failure", "failure", why=why)), tuple(episodes), {})
