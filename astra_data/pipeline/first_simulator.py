"""The first abstract simulator of a new robot: code, guessed from its logs and judged by replaying them."""

import json
import keyword
import os.path
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from itertools import islice, product
from string import Template
from typing import Any

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import torch
from astra_data.dataset.checkup import QUATERNION
from astra_data.dataset.columns import Column
from astra_data.io.guessing import HEADING, PLACE, TURNED, Field, Logs

JUDGED_STEPS = 10  # after so many steps a simulator should be better than standing still
CLEARLY = 1.05  # errors that are larger by less than this factor may be chance
AXES = (("x", "y"), ("east", "north"), ("easting", "northing"), ("longitude", "latitude"), ("lon", "lat"))
RATE = r"rate|vel(ocity)?|speed|dot"
TURN_RATE = re.compile(
    rf"r|w_?z?|omega(_?z)?|(.+_)?(turn|ang(ular)?(_({RATE}))?(_z)?|(v|d|vel_|velocity_)({TURNED}|th|rot|ang)|"
    rf"({TURNED}|turn(ing)?|rot(ation)?)_?({RATE}))"
)
TURN = re.compile(rf"{TURN_RATE.pattern}|.*(turn|yaw|ang|(?<!th)rot|steer|rudder).*")
STEERING = re.compile(r"(.+_)?steer(ing)?(_?(angle|ang))?")
SIDE = re.compile(r"(left|port|(?<![a-z])[vw]?l(?![a-z]))|right|starboard|(?<![a-z])[vw]?r(?![a-z])")
AHEAD = re.compile(r"v|(.+_)?(speed|vel(ocity)?|throttle|forward|surge|(linear|v)(_?x)?)(_.+)?")
SIDEWAYS = re.compile(r"(.+_)?(sway(_.+)?|(v|vel|velocity|linear)_?y)")
HEADINGS: tuple[tuple[re.Pattern[str], Sequence[str], str, str], ...] = (
    (HEADING, ("_x", "_y"), "{0}", "{1}"),
    (HEADING, ("",), "of.cos({0})", "of.sin({0})"),
    (QUATERNION, "xyzw", "{3} ** 2 - {2} ** 2 + {0} ** 2 - {1} ** 2", "2 * {3} * {2} + 2 * {0} * {1}"),
    (QUATERNION, "zw", "{1} ** 2 - {0} ** 2", "2 * {1} * {0}"),
)  # how a heading's names begin and end; its cosine and sine by these values
SPEED = re.compile(
    rf"(?<![a-z])(v|d)(?=([xyz]|q|j|{TURNED}|roll|pitch|th|rot|ang|joint)(_|\d|$))|(?<=q)d(?=_?\d|$)|"
    rf"(^|_)({RATE})(?=_|\d|$)"
)
GENERIC = re.compile(
    r"(^|_)(pos(ition)?|pose|joints?|states?|odom|twist|linear|angular|torque|tau|effort|moment|force|angle|motor|"
    r"data|command|q|j|a|s|u)(?=_|\d|$)"
)  # words that do not tell one moving part of a robot from another
FORCES = ("N", "N m")
DIRECT = "values that commands move"


@dataclass(frozen=True)
class StateEntry:
    """A part of abstract states: `code` of a value, or of cosine and sine of an angle, by names of its `fields`."""

    name: str
    unit: str
    fields: tuple[Field, ...]
    code: tuple[str, ...]

    @property
    def names(self) -> list[str]:
        """The names of its one or two values."""
        return [self.name] if len(self.code) == 1 else [f"{self.name}_x", f"{self.name}_y"]

    def shown(self, cosine: str, sine: str) -> list[str]:
        """Return expressions of these values, by the variable `name`."""
        return [self.name] if len(self.code) == 1 else [cosine.format(self.name), sine.format(self.name)]


@dataclass(frozen=True)
class SimulatorKind:
    """An abstract simulator of X values and A commands, as code; `driven` are variables of commands by their names."""

    logs: Logs
    called: str
    entries: tuple[StateEntry, ...]
    driven: dict[str, str]
    lines: tuple[str, ...]
    constants: dict[str, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """The names of the X values of its states."""
        return [name for entry in self.entries for name in entry.names]

    @property
    def described(self) -> str:
        """What it is and what moves it, in one line."""
        states = ", ".join(field.short for entry in self.entries for field in entry.fields)
        by = ", ".join(field.short for field in self.logs.of("command") if field.name in self.driven)
        fitted = [f"{name.lower()} {value:g}" for name, value in self.constants.items()]
        return "; ".join([f"{self.called}: {states}, moved by {by}", *fitted, *map("CHECK: {}".format, self.remarks)])

    def code(self) -> str:
        """Return its class."""
        states, commands = self.logs.of("state"), self.logs.of("command")
        fields = list(dict.fromkeys(field for entry in self.entries for field in entry.fields))
        names, spare = identifiers(states), identifiers(commands, "cmd_")
        values = {
            "sentence": f"{self.called[0].upper()}{self.called[1:]}, without lag and slip.",
            "units": json.dumps(["1" if len(e.code) > 1 else e.unit for e in self.entries for _ in e.code]),
            "parameters": "".join(f', "{name.lower()}": {name}' for name in self.constants),
            "inputs": unpacked([names[field.name] for field in fields]),
            "indices": repr(tuple(map(states.index, fields))),
            "abstract": ", ".join(code for entry in self.entries for code in entry.code),
            "remarks": "".join(f"; {remark}" for remark in self.remarks),
            "variables": unpacked(self.names),
            "commands": unpacked([self.driven.get(command.name, spare[command.name]) for command in commands]),
            "lines": "\n        ".join(self.lines),
            "shown": ", ".join(code for entry in self.entries for code in entry.shown("{}.cos()", "{}.sin()")),
        }
        return filled("simulator.py", values)

    def built(self, count: int) -> Any:  # noqa: ANN401 - an instance of the code
        """Return `count` simulators."""
        space = {"np": np, "torch": torch, "Column": Column, "NAMES": tuple(self.names), **self.constants}
        exec(self.code(), space | {"TIMESTEP_S": 1 / self.logs.rate}, space)
        return space["Simulator"](count)  # type: ignore[operator]

    def episodes(self) -> list[tuple[Floats, Floats]]:
        """Return the abstract states (T, X) and commands (T, A) of each episode."""
        phi, logs = self.built(1).abstraction, self.logs
        states = [np.asarray(phi(values)) for values in logs.values(logs.of("state"))]
        return list(zip(states, logs.values(logs.of("command")), strict=True))

    def after(self, states: Floats, commands: Sequence[Floats]) -> Floats:
        """Return where abstract states (B, X) land after some commands (B, A)."""
        simulator = self.built(len(states))
        simulator.reset_to(torch.from_numpy(states))
        for command in commands:
            simulator.step(torch.from_numpy(command))
        return np.asarray(simulator.state)

    def errors(self) -> tuple[Floats, Floats]:
        """Return the mean errors (X,) after `JUDGED_STEPS` from each row, or one, and those of standing still."""
        episodes = self.episodes()
        steps = JUDGED_STEPS if any(len(states) > JUDGED_STEPS for states, _ in episodes) else 1
        long = [(states, commands) for states, commands in episodes if len(states) > steps]
        starts, ends = (np.concatenate(rows) for rows in zip(*((s[:-steps], s[steps:]) for s, _ in long), strict=True))
        found = self.after(starts, [np.concatenate([c[k : k - steps] for _, c in long]) for k in range(steps)])
        return np.abs(found - ends).mean(axis=0), np.abs(starts - ends).mean(axis=0)

    def slopes(self, moves: Callable[[Floats, Floats], Floats], steps: int) -> list[float]:
        """Return how many times as far the robot `moves` (T, K) in so many steps, as a lag is slow in one; or 0."""
        sums: list[list[Floats]] = []
        for states, commands in self.episodes():
            landed = self.after(states[:-1], [commands[:-1]])
            totals = [np.cumsum(np.insert(moves(states[:-1], to), 0, 0, axis=0), axis=0) for to in (landed, states[1:])]
            sums.append([t[min(steps, len(t) - 1) :] - t[: max(1, len(t) - steps)] for t in totals])
        simulated, recorded = map(np.concatenate, zip(*sums, strict=True))
        power = (simulated**2).sum(axis=0)
        slopes = np.divide((simulated * recorded).sum(axis=0), power, np.zeros(len(power)), where=power > 0)
        return [float(f"{slope:.3g}") for slope in slopes]


def first_simulator(logs: Logs) -> SimulatorKind:
    """Return a simulator of the first kind that no other predicts `logs` clearly better than."""
    good, direct, kinds = None, _direct(logs, None), _planar(logs)
    if errors := [[one[:4].reshape(2, 2).sum(axis=1) for one in kind.errors()] for kind in kinds]:
        shares = [float(np.divide(found, still, np.ones(2), where=still > 0).mean()) for found, still in errors]
        best = next(at for at, share in enumerate(shares) if share <= CLEARLY * min(shares))
        good, (simulated, still) = kinds[best], errors[best]
        along = {name for name, way in good.driven.items() if way != "turn"}
        if "left" in good.driven.values() and along <= direct.driven.keys():
            moved = dict(zip(direct.names, direct.errors()[0], strict=True))
            place = [entry.code[0] for entry in good.entries[:2]]
            along_axes = sum(moved[name] for name in place) if {*place} <= moved.keys() else still[0]
            good = good if simulated[0] < along_axes else None  # two arms, or a base that is driven along x and y
    if not good:
        if not direct.entries:
            left_out = ", ".join(f"{one.name} ({one.why})" for one in logs.fields if one.role == "left out")
            without = f"; left out: {left_out}" if left_out else ""
            advice = f"name it as its command, cmd_q1 and q1{without}"
            raise BadInputError(f"found no state that a command could move: {advice}")
        return direct
    rest = _direct(logs, good)
    merged = {name: getattr(good, name) + getattr(rest, name) for name in ("entries", "lines", "remarks")}
    return replace(good, driven=good.driven | rest.driven, constants=good.constants | rest.constants, **merged)


def filled(name: str, values: Mapping[str, str]) -> str:
    """Return a file of a new robot, by the name of its template."""
    text = (files("astra_data.pipeline") / f"robot_files/{name}.template").read_text(encoding="utf-8")
    return Template(text).substitute(values)


def identifiers(fields: Sequence[Field], prefix: str = "") -> dict[str, str]:
    """Return a different name of a variable for each field, by the field's name."""
    found: dict[str, str] = {}
    for one in fields:
        plain = f"{prefix}{one.plain}"
        if not plain.isidentifier() or keyword.iskeyword(plain) or plain in ("of", "np", "torch", "state", "self"):
            plain = f"s_{plain}" if f"s_{plain}".isidentifier() else f"s_{len(found)}"
        while plain in found.values():
            plain += "_2"
        found[one.name] = plain
    return found


def unpacked(names: Sequence[str]) -> str:
    """Return the left side of an assignment to all of them."""
    return ", ".join(names) if len(names) > 1 else f"({names[0]},)"


def _planar(logs: Logs) -> list[SimulatorKind]:
    """Return simulators of robots on a plane, if there are a position and a heading that commands move."""
    states, names = {one.plain: one for one in logs.of("state")}, identifiers(logs.of("state"))
    pairs = (
        (states[name], states[f"{name.removesuffix(one)}{other}"])
        for one, other in AXES
        for name in sorted(states, key=len)
        if name.endswith(one) and f"{name.removesuffix(one)}{other}" in states
        if PLACE.fullmatch(name) or len(one) > 2
    )
    found: list[SimulatorKind] = []
    for fields in islice(pairs, 1):
        place = [StateEntry(axis, "m", (one,), (names[one.name],)) for axis, one in zip("xy", fields, strict=True)]
        for (heading, remarks), (called, driven, lines) in product(
            _headings(states, names, fields[0].plain), _drives(logs.of("command"))
        ):
            step = ("heading = torch.atan2(heading_y, heading_x)", *lines)
            kind = SimulatorKind(logs, called, (*place, heading), driven, step, _sizes(lines, 1.0, 1.0), remarks)
            slopes = kind.slopes(_forward_and_turn, JUDGED_STEPS)
            is_off = all(slopes) and any(not 0.5 < slope < 2 for slope in slopes)
            if not is_off and "TURN_PER_COMMAND" in kind.constants:
                step = tuple(line for line in step if "PER_COMMAND" not in line)
                found.append(replace(kind, lines=step, constants={}))
            elif all(slopes):
                found.append(replace(kind, constants=_sizes(lines, *slopes)))
    return found


def _sizes(lines: Sequence[str], speed: float, turn: float) -> dict[str, float]:
    """Return the constants of a drive's lines, by the slopes of its speed and turning where all are 1."""
    sizes = {"SPEED_PER_COMMAND": speed, "TURN_PER_COMMAND": turn, "TRACK_M": speed / turn, "WHEELBASE_M": 1 / turn}
    return {name: float(f"{size:.3g}") for name, size in sizes.items() if any(name in line for line in lines)}


def _headings(states: dict[str, Field], names: dict[str, str], beside: str) -> list[tuple[StateEntry, tuple[str, ...]]]:
    """Return what the heading may be, of cosine and sine, an angle or a quaternion, and remarks of it."""
    near = sorted(states, key=lambda name: (-len(os.path.commonprefix([name, beside])), len(name)))  # noqa: RUF071
    for (pattern, ends, *code), name in product(HEADINGS, near):
        stem = name.removesuffix(ends[0])
        parts = [f"{stem}{end}" for end in ends]
        if parts[0] != name or not pattern.fullmatch(stem) or not {*parts} <= states.keys():
            continue
        fields = tuple(states[part] for part in parts)
        cosine, sine = (text.format(*(names[one.name] for one in fields)) for text in code)
        ways: list[tuple[StateEntry, tuple[str, ...]]] = [(StateEntry("heading", "1", fields, (cosine, sine)), ())]
        if len(ends) == 1:
            remark = f"{fields[0].short} is clockwise from the axis of y, as of a compass"
            ways.append((StateEntry("heading", "1", fields, (sine, cosine)), (remark,)))
        return ways[::-1] if re.search("compass|course|cog|azimuth|hdg", name) else ways
    return []


def _drives(commands: Sequence[Field]) -> list[tuple[str, dict[str, str], tuple[str, ...]]]:
    """Return kinds of drives that have such commands, variables of these and lines of a step; then other units."""
    along: tuple[str, ...] = (
        "x = x + speed * heading.cos() * TIMESTEP_S",
        "y = y + speed * heading.sin() * TIMESTEP_S",
        "heading = heading + turn * TIMESTEP_S",
    )
    sides = [side for command in commands if (side := SIDE.search(command.plain))]
    if len(commands) == 2 == len(sides) and len({SIDE.sub("", command.plain) for command in commands}) == 1:
        driven = {c.name: "left" if side[1] else "right" for c, side in zip(commands, sides, strict=True)}
        speed, turn = "speed = SPEED_PER_COMMAND * (left + right) / 2", "SPEED_PER_COMMAND * (right - left) / TRACK_M"
        return [("a differential drive", driven, (speed, f"turn = {turn}", *along))]
    turns = [c for c in commands if _is_turn_rate(c) or (TURN.fullmatch(c.plain) and c.unit != "m/s")]
    turns = turns or [command for command in commands if command.unit == "rad/s"]
    straight = [command for command in commands if command not in turns]
    aside = [c for c in straight if c.unit in ("1", "m/s") and SIDEWAYS.fullmatch(c.plain)]
    called, used = "a unicycle", ["speed", "turn"]
    if len(commands) == 2 and not turns and not aside:
        straight, turns = [commands[0]], [commands[1]]
        called += f" (CHECK: {turns[0].short} is used as a turn rate, although nothing says so)"
    ahead = [c for c in straight if len(commands) == 2 or c.unit == "m/s" or AHEAD.fullmatch(c.plain)]
    if not (turns or aside) or not ahead:
        return []
    driven, found = dict(zip([one.name for one in (ahead[0], *turns[:1])], used, strict=False)), []
    if turns and turns[0].unit in ("1", "rad") and STEERING.fullmatch(turns[0].plain):
        lines = ("turn = speed * angle.tan() / WHEELBASE_M", *along)
        found.append(("a bicycle", {ahead[0].name: "speed", turns[0].name: "angle"}, lines))
    if aside:
        called, driven, used = "a holonomic base", driven | {aside[0].name: "left"}, ["turn"] * bool(turns)
        x, y = "x - left * heading.sin() * TIMESTEP_S", "y + left * heading.cos() * TIMESTEP_S"
        along = (f"x = {x}", f"y = {y}", *along[: 2 + bool(turns)])
    factors = [f"{name} = {name.upper()}_PER_COMMAND * {name}" for name in used]
    return [*found, (called, driven, (*factors, *along))]


def _is_turn_rate(command: Field) -> bool:
    is_turned = command.unit == "rad/s" and HEADING.fullmatch(command.plain)
    return bool(is_turned or (command.unit in ("1", "rad/s") and TURN_RATE.fullmatch(command.plain)))


def _forward_and_turn(before: Floats, after: Floats) -> Floats:
    """Return by how much (T, 2) x, y, cosine and sine (T, 4) went along their heading, and turned."""
    (dx, dy), (cos, sin), (then_cos, then_sin) = (after - before).T[:2], before.T[2:4], after.T[2:4]
    turned = np.arctan2(cos * then_sin - sin * then_cos, cos * then_cos + sin * then_sin)
    return np.column_stack([dx * cos + dy * sin, turned])


def _direct(logs: Logs, planar: SimulatorKind | None) -> SimulatorKind:
    """Return the simulator of the other commands: each moves the state of the same name."""
    left = [one for one in logs.of("state") if not planar or all(one not in entry.fields for entry in planar.entries)]
    moves: dict[Field, list[Field]] = {}
    for command in (one for one in logs.of("command") if not planar or one.name not in planar.driven):
        moves[command] = _moved(command, left, is_alone=len(logs.of("command")) == 1)
        left = [one for one in left if one not in moves[command]]
    idle = [command.short for command in moves if not moves[command]]
    remarks = [f"{' and '.join(idle)} {'has' if len(idle) == 1 else 'have'} no effect"] if idle else []
    if turned := [one.short for one in left if HEADING.fullmatch(one.plain) or "angle" in one.plain]:
        are, them = ("is", "it") if len(turned) == 1 else ("are", "them")
        remarks.append(f"{' and '.join(turned)} {are} not in φ, though failures may come of {them}")
    inputs, variables = identifiers(logs.of("state")), identifiers(logs.of("command"), "cmd_")
    words = {"x", "y", "heading", *planar.driven.values()} if planar else set()
    names = {key: f"s_{name}" if name in words else name for key, name in inputs.items()}
    entries: dict[Field, StateEntry] = {}
    lines: list[tuple[str, str]] = []  # of each command: as a rate, and as a target
    pushed, moved = [], [(command, found) for command, found in moves.items() if found]
    for command, found in moved:
        given, at, now = variables[command.name], [names[one.name] for one in found], names[found[0].name]
        for one in found:
            code: tuple[str, ...] = (inputs[one.name],)
            is_angle = one.unit == "rad" and HEADING.fullmatch(one.plain)
            if is_angle and np.ptp(np.concatenate(logs.values([one]))) > np.pi:
                code, now = (f"of.cos({code[0]})", f"of.sin({code[0]})"), f"torch.atan2({now}_y, {now}_x)"
            entries[one] = StateEntry(names[one.name], one.unit, (one,), code)
        lines.append((f"{at[0]} = {now} + {given} * TIMESTEP_S", f"{at[0]} = {given}"))
        if command.unit in FORCES:
            pushed.append(at[-1])
            push = f"{at[-1]} = {at[-1]} + {at[-1].upper()}_PER_FORCE * {given} * TIMESTEP_S"
            lines[-1] = (push + f"\n        {at[0]} = {at[0]} + {at[-1]} * TIMESTEP_S" * (len(at) > 1),) * 2
    driven = {command.name: variables[command.name] for command, _ in moved}
    gains, rates = {f"{name.upper()}_PER_FORCE": 1.0 for name in pushed}, tuple(rate for rate, _ in lines)
    kind = SimulatorKind(logs, DIRECT, tuple(entries.values()), driven, rates, gains, tuple(remarks))
    if pushed:
        speeds = [kind.names.index(name) for name in pushed]
        slopes = kind.slopes(lambda before, after: (after - before)[:, speeds], 1)
        kind = replace(kind, constants=dict(zip(gains, slopes, strict=True)))
    if not moved:
        return kind
    errors = kind.errors()[0], replace(kind, lines=tuple(target for _, target in lines)).errors()[0]
    chosen = []
    for (command, (state, *_)), ways in zip(moved, lines, strict=True):
        values = [kind.names.index(name) for name in entries[state].names]
        rate, target = (error[values].sum() for error in errors)
        is_same = command.unit == state.unit
        if "1" in (command.unit, state.unit):
            is_same = _is_speed(state) and command.plain == state.plain
        chosen.append(ways[is_same or bool(rate > target)])
    return replace(kind, lines=tuple(chosen))


def _moved(command: Field, states: Sequence[Field], *, is_alone: bool) -> list[Field]:
    """Return the state that a command moves, or the place and speed that a force does; nothing if none."""
    unit = "rad/s" if _is_turn_rate(command) else command.unit
    fitting = [one for one in states if "1" in (unit, one.unit) or one.unit in (unit, unit.removesuffix("/s"))]
    same = sorted((one for one in states if _key(one) == _key(command)), key=_is_speed)
    if command.unit in FORCES:
        places, speeds = ([one for one in same if _is_speed(one) is flag][:1] for flag in (False, True))
        return [*places, *speeds] if speeds else []
    places = [one for one in fitting if not _is_speed(one)]
    if command.short == "command" and is_alone:
        return places if len(places) == 1 else []
    headings = [one for one in places if _is_turn_rate(command) and HEADING.fullmatch(one.plain)]
    return ([one for one in same if one in fitting] or headings)[:1]


def _key(one: Field) -> str:
    """Return a name without words of quantities, which a command and its state have in common."""
    return re.sub("_+", "_", GENERIC.sub("", SPEED.sub("", one.plain))).strip("_") or one.plain


def _is_speed(one: Field) -> bool:
    return one.unit.endswith("/s") or SPEED.search(one.plain) is not None or _is_turn_rate(one)
