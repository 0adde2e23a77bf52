"""The first abstract simulator of a new robot: code, guessed from its logs and judged by replaying them."""

import json
import keyword
import os.path
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np
import torch

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Column
from astra_data.io.guessing import HEADING, PLACE, TURNED, Field, Logs

JUDGED_STEPS = 10
"""After so many steps a simulator should be better than standing still."""
CLEARLY = 1.05
"""Errors that are larger by less than this factor may be chance."""
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
BODY = re.compile(r"(.+_)?(?P<axis>surge|sway|heave)(_.+)?")
"""Speeds along a vessel, which are along no axis of the world."""
AXIS_SPEED = re.compile(r"(.+_)?(v|vel|velocity|linear)?_?(?P<axis>[xy])")
QUATERNION = re.compile(r"(.+_)?(q|quat(ernion)?|orient(ation)?|rot(ation)?)_?[wxyz]")
SPEED = re.compile(
    rf"(?<![a-z])(v|d)(?=([xyz]|q|j|{TURNED}|roll|pitch|th|rot|ang|joint)(_|\d|$))|(?<=q)d(?=_?\d|$)|"
    rf"(^|_)({RATE})(?=_|\d|$)"
)
GENERIC = re.compile(
    r"(^|_)(pos(ition)?|pose|joints?|states?|odom|twist|linear|angular|torque|tau|effort|moment|force|angle|motor|"
    r"data|command|q|j|a|s|u)(?=_|\d|$)"
)
"""Words that do not tell one moving part of a robot from another."""
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
    shares = []
    for kind in (kinds := _planar(logs)):
        simulated, still = (errors[:4].reshape(2, 2).sum(axis=1) for errors in kind.errors())
        shares.append(float(np.divide(simulated, still, np.ones(2), where=still > 0).mean()))
    good = next((kind for kind, share in zip(kinds, shares, strict=True) if share <= CLEARLY * min(shares)), None)
    if good and "TRACK_M" in good.constants and min(shares) >= 1:
        good = None  # two arms rather than two wheels
    rest = _direct(logs, good)
    if not good:
        if not rest.entries:
            raise BadInputError("found no state that a command could move: name it as its command, cmd_q1 and q1")
        return rest
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
    position = next(
        (
            (name, f"{name.removesuffix(one)}{other}")
            for one, other in AXES
            for name in sorted(states, key=len)
            if name.endswith(one) and f"{name.removesuffix(one)}{other}" in states
            if PLACE.fullmatch(name) or len(one) > 2
        ),
        None,
    )
    if position is None:
        return []
    fields = [states[name] for name in position]
    place = [StateEntry(axis, "m", (one,), (names[one.name],)) for axis, one in zip("xy", fields, strict=True)]
    found = []
    for heading, remarks in _headings(states, names, position[0]):
        for called, driven, lines in _drives(logs.of("command")):
            step = ("heading = torch.atan2(heading_y, heading_x)", *lines)
            kind = SimulatorKind(logs, called, (*place, heading), driven, step, _sizes(lines, 1.0, 1.0), remarks)
            speed, turn = kind.slopes(_forward_and_turn, JUDGED_STEPS)
            is_off = any(not 0.5 < slope < 2 for slope in (speed, turn))
            if not kind.constants:
                found.append(kind)
            elif speed and turn and (is_off or "TURN_PER_COMMAND" not in kind.constants):
                found.append(replace(kind, constants=_sizes(lines, speed, turn)))
    return found


def _sizes(lines: Sequence[str], speed: float, turn: float) -> dict[str, float]:
    """Return the constants of a drive's lines, by the slopes of its speed and turning where all are 1."""
    sizes = {"SPEED_PER_COMMAND": speed, "TURN_PER_COMMAND": turn, "TRACK_M": speed / turn, "WHEELBASE_M": 1 / turn}
    return {name: float(f"{size:.3g}") for name, size in sizes.items() if any(name in line for line in lines)}


def _headings(states: dict[str, Field], names: dict[str, str], beside: str) -> list[tuple[StateEntry, tuple[str, ...]]]:
    """Return what the heading may be, of cosine and sine, an angle or a quaternion, and remarks of it."""

    def heading(parts: Sequence[str], cosine: str, sine: str) -> StateEntry:
        code = [
            text.format(**{name: names[states[part].name] for name, part in zip("xyzw", parts, strict=False)})
            for text in (cosine, sine)
        ]
        return StateEntry("heading", "1", tuple(states[part] for part in parts), tuple(code))

    near = sorted(states, key=lambda name: (-len(os.path.commonprefix([name, beside])), len(name)))  # noqa: RUF071
    for stem in (name[:-2] for name in near if HEADING.fullmatch(name[:-2])):
        if {f"{stem}_x", f"{stem}_y"} <= states.keys():
            return [(heading((f"{stem}_x", f"{stem}_y"), "{x}", "{y}"), ())]
    for name in filter(HEADING.fullmatch, near):
        remarks = (f"{states[name].short} is clockwise from the axis of y, as of a compass",)
        angle, compass = heading([name], "of.cos({x})", "of.sin({x})"), heading([name], "of.sin({x})", "of.cos({x})")
        ways = [(angle, ()), (compass, remarks)]
        return ways[::-1] if re.search("compass|course|cog|azimuth|hdg", name) else ways
    for stem in (name[:-1] for name in near if QUATERNION.fullmatch(name)):
        if {f"{stem}{axis}" for axis in "xyzw"} <= states.keys():
            cosine, sine = "{w} ** 2 - {z} ** 2 + {x} ** 2 - {y} ** 2", "2 * {w} * {z} + 2 * {x} * {y}"
            return [(heading([f"{stem}{axis}" for axis in "xyzw"], cosine, sine), ())]
        if {f"{stem}{axis}" for axis in "zw"} <= states.keys():
            return [(heading([f"{stem}{axis}" for axis in "zw"], "{y} ** 2 - {x} ** 2", "2 * {y} * {x}"), ())]
    return []


def _drives(commands: Sequence[Field]) -> list[tuple[str, dict[str, str], tuple[str, ...]]]:
    """Return kinds of drives that have such commands, variables of these and lines of a step; then other units."""
    along = ("x = x + speed * heading.cos() * TIMESTEP_S", "y = y + speed * heading.sin() * TIMESTEP_S")
    turning = "heading = heading + turn * TIMESTEP_S"
    sides = [side for command in commands if (side := SIDE.search(command.plain))]
    if len(commands) == 2 == len(sides) and len({SIDE.sub("", command.plain) for command in commands}) == 1:
        driven = {c.name: "left" if side[1] else "right" for c, side in zip(commands, sides, strict=True)}
        speed, turn = (
            "speed = SPEED_PER_COMMAND * (left + right) / 2",
            "turn = SPEED_PER_COMMAND * (right - left) / TRACK_M",
        )
        return [("a differential drive", driven, (speed, turn, *along, turning))]
    turns = [c for c in commands if _is_turn_rate(c) or (TURN.fullmatch(c.plain) and c.unit != "m/s")]
    turns = turns or [command for command in commands if command.unit == "rad/s"]
    straight = [command for command in commands if command not in turns]
    axes = {"x": "forward", "surge": "forward", "y": "left", "sway": "left"}
    ways = {
        axes.get(m["axis"]): c
        for c in straight
        if (m := BODY.fullmatch(c.plain) or AXIS_SPEED.fullmatch(c.plain)) and c.unit in ("1", "m/s")
    }
    found: list[tuple[str, dict[str, str], tuple[str, ...]]] = []
    if {"forward", "left"} <= ways.keys():
        turned, end = {turn.name: "turn" for turn in turns[:1]}, (turning,) * bool(turns)
        x, y = "forward * heading.cos() - left * heading.sin()", "forward * heading.sin() + left * heading.cos()"
        frames = [("a holonomic base", ("forward", "left"), (x, y))]
        if not any(BODY.fullmatch(way.plain) for way in ways.values()):
            frames.append(("a holonomic base, driven along x and y", ("east", "north"), ("east", "north")))
        for called, names, speeds in frames:
            driven = dict(zip((ways["forward"].name, ways["left"].name), names, strict=True)) | turned
            moves = [f"{at} = {at} + ({by}) * TIMESTEP_S" for at, by in zip("xy", speeds, strict=True)]
            found.append((called, driven, (*moves, *end)))
    else:
        called = "a unicycle"
        if len(commands) == 2 and not turns:
            straight, turns = [commands[0]], [commands[1]]
            called += f" (CHECK: {turns[0].short} is used as a turn rate, although nothing says so)"
        ahead = [c for c in straight if len(commands) == 2 or c.unit == "m/s" or AHEAD.fullmatch(c.plain)]
        if not turns or not ahead:
            return []
        if turns[0].unit in ("1", "rad") and STEERING.fullmatch(turns[0].plain):
            driven = {ahead[0].name: "speed", turns[0].name: "angle"}
            found.append(("a bicycle", driven, ("turn = speed * angle.tan() / WHEELBASE_M", *along, turning)))
        found.append((called, {ahead[0].name: "speed", turns[0].name: "turn"}, (*along, turning)))
    used = [name for name in ("speed", "turn") if name in found[-1][1].values()]
    factors = [f"{name} = {name.upper()}_PER_COMMAND * {name}" for name in used]
    scaled = [(called, driven, (*factors, *lines)) for called, driven, lines in found if called != "a bicycle"]
    return found + scaled if factors else found


def _is_turn_rate(command: Field) -> bool:
    """Return whether a heading changes by it."""
    is_turned = command.unit == "rad/s" and HEADING.fullmatch(command.plain)
    return bool(is_turned or (command.unit in ("1", "rad/s") and TURN_RATE.fullmatch(command.plain)))


def _forward_and_turn(before: Floats, after: Floats) -> Floats:
    """Return by how much (T, 2) x, y, cosine and sine (T, 4) went along their heading, and turned."""
    (dx, dy), (cos, sin), (then_cos, then_sin) = (after - before).T[:2], before.T[2:4], after.T[2:4]
    turned = np.arctan2(cos * then_sin - sin * then_cos, cos * then_cos + sin * then_sin)
    return np.column_stack([dx * cos + dy * sin, turned])


def _direct(logs: Logs, planar: SimulatorKind | None) -> SimulatorKind:
    """Return the simulator of the other commands: each moves the state of the same name."""
    taken = [one for entry in planar.entries for one in entry.fields] if planar else []
    left = [one for one in logs.of("state") if one not in taken]
    moves: list[tuple[Field, list[Field]]] = []
    for command in (one for one in logs.of("command") if not planar or one.name not in planar.driven):
        moves.append((command, _moved(command, left, is_alone=len(logs.of("command")) == 1)))
        left = [one for one in left if one not in moves[-1][1]]
    idle = [command.short for command, found in moves if not found]
    remarks = [f"{' and '.join(idle)} {'has' if len(idle) == 1 else 'have'} no effect"] if idle else []
    if turned := [one.short for one in left if HEADING.fullmatch(one.plain) or "angle" in one.plain]:
        are, them = ("is", "it") if len(turned) == 1 else ("are", "them")
        remarks.append(f"{' and '.join(turned)} {are} not in φ, though failures may come of {them}")
    moves = [(command, found) for command, found in moves if found]
    inputs, variables = identifiers(logs.of("state")), identifiers(logs.of("command"), "cmd_")
    words = {"x", "y", "heading", *planar.driven.values()} if planar else set()
    names = {key: f"s_{name}" if name in words else name for key, name in inputs.items()}
    driven = {command.name: variables[command.name] for command, _ in moves}

    def simulator(rates: Sequence[bool], constants: dict[str, float]) -> SimulatorKind:
        entries, lines = [], []
        for (command, found), is_rate in zip(moves, rates, strict=True):
            given, at, now = variables[command.name], [names[one.name] for one in found], names[found[0].name]
            for one in found:
                code: tuple[str, ...] = (inputs[one.name],)
                if (
                    one.unit == "rad"
                    and HEADING.fullmatch(one.plain)
                    and np.ptp(np.concatenate(logs.values([one]))) > np.pi
                ):
                    code = (f"of.cos({code[0]})", f"of.sin({code[0]})")
                    now = f"torch.atan2({now}_y, {now}_x)"
                entries.append(StateEntry(names[one.name], one.unit, (one,), code))
            if command.unit in FORCES:
                lines.append(f"{at[-1]} = {at[-1]} + {at[-1].upper()}_PER_FORCE * {given} * TIMESTEP_S")
                lines += [f"{at[0]} = {at[0]} + {at[1]} * TIMESTEP_S"] if len(at) > 1 else []
            else:
                lines.append(f"{at[0]} = {now} + {given} * TIMESTEP_S" if is_rate else f"{at[0]} = {given}")
        return SimulatorKind(logs, DIRECT, tuple(entries), driven, tuple(lines), constants, tuple(remarks))

    pushed = [names[found[-1].name] for command, found in moves if command.unit in FORCES]
    plain = simulator([True] * len(moves), {f"{name.upper()}_PER_FORCE": 1.0 for name in pushed})
    if not moves:
        return plain
    places = {entry.fields[0]: [plain.names.index(name) for name in entry.names] for entry in plain.entries}
    at = [plain.names.index(name) for name in pushed]
    slopes = plain.slopes(lambda before, after: (after - before)[:, at], 1) if at else []
    gains = dict(zip(plain.constants, slopes, strict=True))
    one, other = (simulator([is_rate] * len(moves), gains).errors()[0] for is_rate in (True, False))
    rates = []
    for command, (state, *_) in moves:  # whether it is what is commanded, or what the command is a rate of
        is_same = command.unit == state.unit
        if "1" in (command.unit, state.unit):
            is_same = _is_speed(state) and command.plain == state.plain
        rates.append(not is_same and bool(one[places[state]].sum() <= other[places[state]].sum()))
    return simulator(rates, gains)


def _moved(command: Field, states: Sequence[Field], *, is_alone: bool) -> list[Field]:
    """Return the state that a command moves, or the place and speed that a force does; nothing if none."""
    if BODY.fullmatch(command.plain):
        return [one for one in states if one.plain == command.plain]
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
