"""The abstract simulators of new robots that drive on a plane, and how they fit their logs."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.exchange.field_names import LENGTH
from astra_data.exchange.logs import Field, Logs
from astra_data.experiments.kind_errors import errors
from astra_data.experiments.planar_heading import Heading
from astra_data.experiments.written_values import numbers, typical

_TURNS = re.compile(r"w|wz|omega|.*(turn|yaw|ang|(?<!th)rot|steer).*")
_SIDE = re.compile(r"left|right|(?<![a-z])[vw]?[lr](?![a-z])")
_COMMAND = {"turn": 0.0, "right": 2.0}
"""Of which a written test takes a step; others are 1."""
_SPEED_AXIS = re.compile(r"(.+_)?(v|vel|velocity|linear)_?[xy]")
_ALONG_BODY = re.compile(r"(.+_)?(?P<axis>surge|sway)(_?(vel|velocity|speed|rate))?")
"""Speeds of vessels, which are along the robot by their names."""


@dataclass(frozen=True)
class Planar:
    """A position, a heading, and commands of speed and of turning: a unicycle.

    Attributes:
        logs: what was recorded.
        position: x and y. heading: of any form.
    """

    logs: Logs
    position: tuple[Field, Field]
    heading: Heading

    template = "planar.py"
    angles = (False, False, True)
    called: ClassVar[str] = "unicycle"

    @property
    def simulator(self) -> str:
        """What it is and what moves it, in a few words."""
        moved, commands = (
            ", ".join(field.short for field in fields)
            for fields in ((*self.position, *self.heading.fields), self.logs.of("command"))
        )
        guess = f"; {self._guess} (CHECK)" if self._guess else ""
        return f"a {self.called}: {moved}, driven by {commands}{guess}"

    @property
    def names(self) -> tuple[str, str, str]:
        """What x, y and the angle are called in the logs."""
        x, y = self.position
        return x.short, y.short, self.heading.name

    @property
    def meanings(self) -> list[str]:
        """What each command is: "turn" for a rate of turning, and for others names of speeds."""
        turn = self._known_turn or self.logs.of("command")[1]
        return ["turn" if field == turn else "speed" for field in self.logs.of("command")]

    @property
    def _known_turn(self) -> Field | None:
        """The command of turning by its name, or as the only one in rad/s; None where nothing says so."""
        commands = self.logs.of("command")
        named = [field for field in commands if field.is_turn_rate or _TURNS.fullmatch(field.plain)]
        by_unit = [field for field in commands if field.unit == "rad/s"]
        found = named or (by_unit if len(by_unit) == 1 else [])
        return found[0] if found else None

    @property
    def _guess(self) -> str:
        """What was taken for what without a reason; nothing where there was one."""
        if self._known_turn:
            return ""
        return f"{self.logs.of('command')[1].short} is used as a turn rate, although nothing says so"

    @classmethod
    def of(cls, logs: Logs) -> Self | None:
        """Return how it fits; None if it does not."""
        pose, commands = pose_of(logs), logs.of("command")
        if pose is None or len(commands) != 2 or _are_along_axes(commands) or are_sides(*commands):
            return None
        return cls(logs, *pose)

    def states(self) -> list[Floats]:
        """Return x, y and the angle of the heading (T, 3) of each episode."""
        poses = self.logs.values((*self.position, *self.heading.fields))
        return [np.column_stack([pose[:, :2], self.heading.angle(pose[:, 2:])]) for pose in poses]

    def step(self, state: Floats, command: Floats) -> Floats:
        """Return where x, y and the angle (B, 3) land by commands (B, A)."""
        given = dict(zip(self.meanings, command.T, strict=True))
        east, north = self._speeds(given, np.cos(state[:, 2]), np.sin(state[:, 2]))
        return state + np.stack([east, north, self._turn(given)], axis=-1) / self.logs.rate

    def _speeds(self, given: dict[str, Floats], cos: Floats, sin: Floats) -> tuple[Floats, Floats]:
        """Return the speeds (B,) along x and y, of commands (B,) by their meaning."""
        return given["speed"] * cos, given["speed"] * sin

    def _turn(self, given: dict[str, Floats]) -> Floats:
        """Return the rate of turning (B,), of commands (B,) by their meaning."""
        return given["turn"]

    def _along(self) -> str:
        """Return the lines of code that `_speeds` and `_turn` are in a simulator."""
        return "east, north = speed * yaw.cos(), speed * yaw.sin()"

    def values(self) -> dict[str, str]:
        """Return what its templates name."""
        order = {field.name: number for number, field in enumerate(self.logs.of("state"))}
        position, heading = (
            [order[field.name] for field in fields] for fields in (self.position, self.heading.fields)
        )
        poses = self.states()
        starts = np.array([pose[0] for pose in poses])
        goal, close = typical([pose[:, :2] for pose in poses], self.logs.failed)
        before = np.array([[0.0, 0.0, math.pi / 2]])
        command = np.array([[_COMMAND.get(meaning, 1.0) for meaning in self.meanings]])
        along, is_in_world = self._along(), "east" in self.meanings
        seen = "heading_x * east + heading_y * north, heading_x * north - heading_y * east"
        return {
            "called": self.called,
            "robot": self.called.title().replace(" ", ""),
            "abstraction": self.heading.abstraction(position, heading),
            "commands": ", ".join(self.meanings),
            "guess": f"  # CHECK: {self._guess}" if self._guess else "",
            "along": f"\n        {along}" if along else "",
            "seen": "east, north" if is_in_world else seen,
            "seen_from": "from where the robot is" if is_in_world else "as the robot sees it",
            "constant": "",
            "parameter": "",
            "goal": numbers(goal, "()"),
            "close": f"{close:.2g}",
            "lows": numbers(starts.min(axis=0)),
            "highs": numbers(starts.max(axis=0)),
            "phi": numbers(_unit_vector(poses[0][0])),
            "before": numbers(_unit_vector(before[0]).round(9)),
            "command": numbers(command[0]),
            "after": numbers(_unit_vector(self.step(before, command)[0]).round(9)),
        }


@dataclass(frozen=True)
class Holonomic(Planar):
    """A position, a heading, and commands of two speeds and of turning: wheels of Mecanum, or legs.

    Attributes:
        is_in_world: whether the speeds are along x and y; otherwise they are forward and to the left.
    """

    is_in_world: bool = False

    called = "holonomic base"

    @property
    def simulator(self) -> str:
        """What it is and what moves it, in a few words."""
        return f"{super().simulator}, {'along x and y' if self.is_in_world else 'forward and to the left'}"

    @property
    def meanings(self) -> list[str]:
        """What each command is: "turn" for a rate of turning, and for others names of speeds."""
        along, across = ("east", "north") if self.is_in_world else ("forward", "left")
        commands = self.logs.of("command")
        return [
            "turn" if field.is_turn_rate else along if _along_axis(field).endswith("x") else across
            for field in commands
        ]

    @classmethod
    def of(cls, logs: Logs) -> Self | None:
        """Return how it fits, with speeds of the frame that predicts the logs better; None if it does not.

        Surge and sway are of the robot's frame, whatever the logs say.
        """
        pose, commands = pose_of(logs), logs.of("command")
        straight = [field for field in commands if not field.is_turn_rate]
        if pose is None or len(commands) - len(straight) != 1 or not _are_along_axes(straight):
            return None
        frames = (False,) if any(map(is_along_body, straight)) else (False, True)
        kinds = [cls(logs, *pose, is_in_world) for is_in_world in frames]
        return min(kinds, key=lambda kind: float(errors(kind, 1)[0][:2].sum()))

    def _speeds(self, given: dict[str, Floats], cos: Floats, sin: Floats) -> tuple[Floats, Floats]:
        if self.is_in_world:
            return given["east"], given["north"]
        forward, left = given["forward"], given["left"]
        return forward * cos - left * sin, forward * sin + left * cos

    def _along(self) -> str:
        if self.is_in_world:
            return ""
        cos, sin = "yaw.cos()", "yaw.sin()"
        return f"east, north = forward * {cos} - left * {sin}, forward * {sin} + left * {cos}"


def pose_of(logs: Logs) -> tuple[tuple[Field, Field], Heading] | None:
    """Return the fields of a position that moves, and the heading; None if one is missing."""
    states = {field.plain: field for field in logs.of("state")}
    for name, x in states.items():
        y = states.get(f"{name[:-1]}y")
        if name[-1] == "x" and y is not None and LENGTH.fullmatch(name) and _moves(logs, (x, y)):
            return ((x, y), heading) if (heading := Heading.of(states)) else None
    return None


def _moves(logs: Logs, fields: Sequence[Field]) -> bool:
    """Return whether one of the fields changes within an episode."""
    return any(np.ptp(values, axis=0).any() for values in logs.values(fields))


def _are_along_axes(commands: Sequence[Field]) -> bool:
    """Return whether they are two speeds, by their names or units, one along x and one along y."""
    names = {
        _along_axis(field)
        for field in commands
        if field.unit == "m/s"
        or (field.unit == "1" and (_SPEED_AXIS.fullmatch(field.plain) or is_along_body(field)))
    }
    return len(commands) == 2 and any(names == {f"{name[:-1]}x", f"{name[:-1]}y"} for name in names)


def is_along_body(field: Field) -> bool:
    """Return whether it is a speed along the robot by its name, surge or sway."""
    return _ALONG_BODY.fullmatch(field.plain) is not None


def _along_axis(field: Field) -> str:
    """Return the plain name of a field, with x in place of surge and y in place of sway."""
    found = _ALONG_BODY.fullmatch(field.plain)
    return f"{found[1] or ''}{'x' if found['axis'] == 'surge' else 'y'}" if found else field.plain


def are_sides(one: Field, other: Field) -> bool:
    """Return whether they are of the left and the right, as of wheels, by names that are alike otherwise."""
    return _SIDE.sub("", one.plain) == _SIDE.sub("", other.plain)


def _unit_vector(pose: Floats) -> Floats:
    """Return x, y, cosine and sine (4,) of x, y and an angle (3,)."""
    return np.array([pose[0], pose[1], math.cos(pose[2]), math.sin(pose[2])])
