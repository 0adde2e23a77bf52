"""The abstract simulators of new robots on wheels, with dimensions that are fitted to their logs."""

import re
from dataclasses import dataclass
from typing import Self

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.exchange.logs import Field, Logs
from astra_data.experiments.kind_errors import CLEARLY, JUDGED_STEPS, errors, judged_steps
from astra_data.experiments.planar_kinds import Planar, are_sides, pose_of

_STEERING = re.compile(r"(.+_)?steer(ing)?(_?(angle|ang))?")
_LEFT = re.compile(r".*(left|(?<![a-z])[vw]?l(?![a-z])).*")


@dataclass(frozen=True)
class Bicycle(Planar):
    """A position, a heading, and commands of speed and of a steering angle: a car.

    Attributes:
        wheelbase_m: from axle to axle, as fitted to the logs; negative where it steers to the right.
    """

    wheelbase_m: float = 1.0

    called = "bicycle"

    @property
    def simulator(self) -> str:
        """What it is and what moves it, in a few words."""
        side = ", steered to the right" if self.wheelbase_m < 0 else ""
        return f"{super().simulator}, wheelbase {abs(self.wheelbase_m):g} m{side}"

    @property
    def meanings(self) -> list[str]:
        """What each command is: "angle" for that of steering, and "speed"."""
        return ["angle" if meaning == "turn" else meaning for meaning in super().meanings]

    @classmethod
    def of(cls, logs: Logs) -> Self | None:
        """Return how it fits; None if it does not, or turns less like the logs than a unicycle."""
        unicycle = Planar.of(logs)
        if unicycle is None:
            return None
        steering = logs.of("command")[unicycle.meanings.index("turn")]
        if steering.unit not in ("1", "rad") or not _STEERING.fullmatch(steering.plain):
            return None
        unit = cls(logs, unicycle.position, unicycle.heading)
        per_meter = _slopes(unit)[1]
        if not per_meter:
            return None
        bicycle = cls(logs, unicycle.position, unicycle.heading, _short(1 / per_meter))
        return bicycle if errors(bicycle, 1)[0][2] < errors(unicycle, 1)[0][2] else None

    def values(self) -> dict[str, str]:
        """Return what its templates name."""
        constant = f"\nWHEELBASE_M = {abs(self.wheelbase_m)!r}  # CHECK: fitted to the logs"
        return super().values() | {"constant": constant, "parameter": ', "wheelbase_m": WHEELBASE_M'}

    def _turn(self, given: dict[str, Floats]) -> Floats:
        turn: Floats = given["speed"] * np.tan(given["angle"]) / self.wheelbase_m
        return turn

    def _along(self) -> str:
        speed = "-speed" if self.wheelbase_m < 0 else "speed"
        return f"turn = {speed} * angle.tan() / WHEELBASE_M\n        {super()._along()}"


@dataclass(frozen=True)
class Differential(Planar):
    """A position, a heading, and commands of a left and a right wheel: a differential drive.

    Attributes:
        speed_per_command: m/s of a wheel for each unit of its command, its radius in m where that is rad/s.
        track_m: from wheel to wheel; negative where what is called left is on the right. Both are fitted.
    """

    speed_per_command: float = 1.0
    track_m: float = 1.0

    called = "differential drive"

    @property
    def simulator(self) -> str:
        """What it is and what moves it, in a few words."""
        side = ", left and right exchanged" if self.track_m < 0 else ""
        speed = f"{self.speed_per_command:g} m/s of a wheel for each {self.logs.of('command')[0].unit}"
        return f"{super().simulator}, {speed}, track {abs(self.track_m):g} m{side}"

    @property
    def meanings(self) -> list[str]:
        """What each command is: that of the "left" and that of the "right" wheel."""
        return ["left" if _is_left(field) else "right" for field in self.logs.of("command")]

    @classmethod
    def of(cls, logs: Logs) -> Self | None:
        """Return how it fits; None if it does not, or turns no more like the logs than standing still."""
        pose, commands = pose_of(logs), logs.of("command")
        if pose is None or len(commands) != 2 or not are_sides(*commands):
            return None
        if any(field.unit not in ("1", "m/s", "rad/s") for field in commands):
            return None
        speed, turn = _slopes(cls(logs, *pose))
        if not speed or not turn:
            return None
        fitted = cls(logs, *pose, _short(speed), _short(speed / turn))
        simulated, still = errors(fitted, judged_steps(fitted.states()))
        return fitted if CLEARLY * simulated[2] < still[2] else None

    def values(self) -> dict[str, str]:
        """Return what its templates name."""
        constants = {"SPEED_PER_COMMAND": self.speed_per_command, "TRACK_M": self.track_m}
        lines = [f"\n{name} = {value!r}  # CHECK: fitted to the logs" for name, value in constants.items()]
        parameters = [f', "{name.lower()}": {name}' for name in constants]
        return super().values() | {"constant": "".join(lines), "parameter": "".join(parameters)}

    @property
    def _guess(self) -> str:
        return ""

    def _speeds(self, given: dict[str, Floats], cos: Floats, sin: Floats) -> tuple[Floats, Floats]:
        speed = self.speed_per_command * (given["left"] + given["right"]) / 2
        return speed * cos, speed * sin

    def _turn(self, given: dict[str, Floats]) -> Floats:
        turn: Floats = self.speed_per_command * (given["right"] - given["left"]) / self.track_m
        return turn

    def _along(self) -> str:
        lines = [
            "speed = SPEED_PER_COMMAND * (left + right) / 2",
            "turn = SPEED_PER_COMMAND * (right - left) / TRACK_M",
            super()._along(),
        ]
        return "\n        ".join(lines)


def _is_left(field: Field) -> bool:
    return _LEFT.fullmatch(field.plain) is not None


def _slopes(kind: Planar) -> tuple[float, float]:
    """Return how many times as far as in a simulator the logs go forward and turn; 0 where it does not move.

    Sums of `JUDGED_STEPS` steps are compared: over one step, what lags behind its command looks slow.
    """
    simulated: list[Floats] = []
    recorded: list[Floats] = []
    for states, commands in zip(kind.states(), kind.logs.values(kind.logs.of("command")), strict=True):
        before = states[:-1]
        for moves, after in ((simulated, kind.step(before, commands[:-1])), (recorded, states[1:])):
            moves.append(_over_steps(_forward_and_turn(before, after)))
    expected, found = np.concatenate(simulated), np.concatenate(recorded)
    powers = (expected**2).sum(axis=0)
    forward, turn = np.divide((expected * found).sum(axis=0), powers, np.zeros(2), where=powers > 0).tolist()
    return forward, turn


def _forward_and_turn(before: Floats, after: Floats) -> Floats:
    """Return by how much (T, 2) states of x, y and an angle (T, 3) went along their heading, and turned."""
    moved, heading = after - before, before[:, 2]
    forward = moved[:, 0] * np.cos(heading) + moved[:, 1] * np.sin(heading)
    return np.column_stack([forward, np.arctan2(np.sin(moved[:, 2]), np.cos(moved[:, 2]))])


def _over_steps(moves: Floats) -> Floats:
    """Return the sums of `JUDGED_STEPS` moves (T, 2) on end, from each row; of all where there are fewer."""
    sums: Floats = np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])
    steps = min(JUDGED_STEPS, len(moves))
    return sums[steps:] - sums[: len(sums) - steps]


def _short(value: float) -> float:
    """Return it in three figures."""
    return float(f"{value:.3g}")
