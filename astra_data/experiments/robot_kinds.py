"""The abstract simulators that a new robot may begin with, and how they fit its logs."""

import json
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.exchange.field_names import HEADING, LENGTH
from astra_data.exchange.guessing import Field, Floats, Logs
from astra_data.experiments.kind_errors import errors

_TURNS = re.compile(r"w|wz|omega|.*(turn|yaw|ang|rot|steer).*")
_SPEED = re.compile(r"^(vel_|velocity_|v|d)(?=[a-z])")


@dataclass(frozen=True)
class Planar:
    """A position, a heading, and commands of speed and of turning: a unicycle.

    Attributes:
        logs: what was recorded.
        position: x and y. heading: an angle, or its cosine and sine.
    """

    logs: Logs
    position: tuple[Field, Field]
    heading: tuple[Field, ...]

    template = "unicycle.py"

    @property
    def simulator(self) -> str:
        """What it is and what moves it, in a few words."""
        moved, commands = (
            ", ".join(field.short for field in fields)
            for fields in ((*self.position, *self.heading), self.logs.of("command"))
        )
        return f"a unicycle: {moved}, driven by {commands}"

    @classmethod
    def of(cls, logs: Logs) -> Self | None:
        """Return how it fits; None if it does not."""
        states = {field.short: field for field in logs.of("state")}
        for short, x in states.items():
            y = states.get(f"{short[:-1]}y")
            if short[-1] != "x" or y is None or not LENGTH.fullmatch(short) or not _moves(logs, (x, y)):
                continue
            angles = [name for name in states if HEADING.fullmatch(name)]
            pairs = [name[:-2] for name in states if HEADING.fullmatch(name[:-2]) and name.endswith("_x")]
            if len(logs.of("command")) != 2 or not (angles or pairs):
                return None
            names = (f"{pairs[0]}_x", f"{pairs[0]}_y") if pairs else (angles[0],)
            return (
                cls(logs, (x, y), tuple(states[name] for name in names))
                if set(names) <= set(states)
                else None
            )
        return None

    def values(self) -> dict[str, str]:
        """Return what its templates name."""
        commands = self.logs.of("command")
        turn = next((number for number, field in enumerate(commands) if _TURNS.fullmatch(field.short)), 1)
        variables = ["speed", "speed"]
        variables[turn] = "turn"
        order = {field.name: number for number, field in enumerate(self.logs.of("state"))}
        indices = [order[field.name] for field in (*self.position, *self.heading)]
        if len(self.heading) == 2:
            abstraction = f"return state[..., {indices}]"
        else:
            x, y, yaw = (f"state[..., {index}]" for index in indices)
            library = "np if isinstance(state, np.ndarray) else torch"
            abstraction = (
                f"of, yaw = {library}, {yaw}\n"
                f"        return of.stack([{x}, {y}, of.cos(yaw), of.sin(yaw)], -1)"
            )
        poses = [self._pose(values) for values in self.logs.values((*self.position, *self.heading))]
        starts = np.array([pose[0] for pose in poses])
        goal, close = _typical([pose[:, :2] for pose in poses])
        x, y, yaw = poses[0][0]
        timestep_s = 1 / self.logs.rate
        return {
            "abstraction": abstraction,
            "commands": ", ".join(variables),
            "goal": _numbers(goal, "()"),
            "close": f"{close:.2g}",
            "lows": _numbers(starts.min(axis=0)),
            "highs": _numbers(starts.max(axis=0)),
            "phi": _numbers([x, y, math.cos(yaw), math.sin(yaw)]),
            "before": "[0.0, 0.0, 0.0, 1.0]",
            "command": _numbers(np.arange(2) != turn),
            "after": _numbers([0.0, timestep_s, 0.0, 1.0]),
        }

    def _pose(self, values: Floats) -> Floats:
        """Return x, y and the angle (T, 3) of positions and headings."""
        yaw = np.arctan2(values[:, 3], values[:, 2]) if len(self.heading) == 2 else values[:, 2]
        return np.column_stack([values[:, :2], yaw])


@dataclass(frozen=True)
class Direct:
    """A state for each command, which does at once what it is told.

    Attributes:
        logs: what was recorded.
        moved: the state that each command moves, those of the first commands.
        is_rate: of each of these commands, whether it is a rate of change; otherwise it is where to be.
    """

    logs: Logs
    moved: tuple[Field, ...]
    is_rate: tuple[bool, ...]

    template = "direct.py"

    @property
    def simulator(self) -> str:
        """What it is and what moves it, in a few words."""
        moves = zip(self.is_rate, self.moved, self.logs.of("command"), strict=False)
        listed: dict[str, list[str]] = {"change": [], "are where they are put": []}
        for is_rate, state, command in moves:
            listed["change" if is_rate else "are where they are put"].append(
                f"{state.short} by {command.short}"
            )
        return "; ".join(
            f"values that {what} as commanded: {', '.join(pairs)}" for what, pairs in listed.items() if pairs
        )

    @property
    def angles(self) -> tuple[bool, ...]:
        """Which of the states are headings, of which whole turns do not count."""
        return tuple(HEADING.fullmatch(field.short) is not None for field in self.moved)

    @classmethod
    def of(cls, logs: Logs) -> Self:
        """Return how it fits: commands move the states of their names, or else the first that may be."""
        left = {field.short: field for field in logs.of("state")}
        moved: list[Field | None] = []
        for command in logs.of("command"):
            names = (_SPEED.sub("", command.short), command.short, command.short.lstrip("u"))
            moved.append(next((left.pop(name) for name in names if name in left), None))
        rest = [field for short, field in left.items() if not _SPEED.match(short)]
        filled = []
        for command, named in zip(logs.of("command"), moved, strict=True):
            field = named or next((one for one in rest if _may_move(command, one)), None)
            rest = [one for one in rest if one is not field]
            filled.append(field)
        found = tuple(field for field in filled[: _length(filled)] if field)
        if not found:
            raise BadInputError(
                "found no state that a command could move: name it as its command, cmd_q1 and q1"
            )
        as_rates, as_targets = (
            errors(cls(logs, found, (is_rate,) * len(found)), 1)[0] for is_rate in (True, False)
        )
        return cls(logs, found, tuple((as_rates <= as_targets).tolist()))

    def states(self) -> list[Floats]:
        """Return the values (T, D) of each episode that commands move."""
        return self.logs.values(self.moved)

    def step(self, state: Floats, command: Floats) -> Floats:
        """Return where states (B, D) land by commands (B, A)."""
        command = command[:, : len(self.moved)]
        return np.where(self.is_rate, state + command / self.logs.rate, command)

    def values(self) -> dict[str, str]:
        """Return what its templates name."""
        order = {field.name: number for number, field in enumerate(self.logs.of("state"))}
        episodes = self.states()
        starts = np.array([values[0] for values in episodes])
        span = np.ptp(np.concatenate(episodes), axis=0)
        goal, close = _typical([values / span for values in episodes])
        actions, moved = len(self.logs.of("command")), len(self.moved)
        command = "command" if actions == moved else f"command[:, :{moved}]"
        rate = f"self.state + TIMESTEP_S * {command}"
        sentence, step = {
            (True,): ("Values that change as they are commanded to.", rate),
            (False,): ("Values that are where they are commanded to be.", command),
            (False, True): (
                "Values that change as they are commanded to, or are where they are commanded to be.",
                f"torch.where(torch.tensor({[*self.is_rate]}), {rate}, {command})",
            ),
        }[tuple(sorted(set(self.is_rate)))]
        before, given = np.arange(moved, dtype=float), np.ones(actions)
        return {
            "names": texts(field.short for field in self.moved),
            "units": texts(field.unit for field in self.moved),
            "goal": _numbers(goal * span, "()"),
            "close": f"{close:.2g}",
            "range": _numbers(span, "()"),
            "sentence": sentence,
            "indices": str([order[field.name] for field in self.moved]),
            "step": step,
            "actions": str(actions),
            "lows": _numbers(starts.min(axis=0)),
            "highs": _numbers(starts.max(axis=0)),
            "phi": _numbers(episodes[0][0]),
            "before": _numbers(before),
            "command": _numbers(given),
            "after": _numbers(self.step(before, given[None])[0]),
        }


def _moves(logs: Logs, fields: Sequence[Field]) -> bool:
    """Return whether one of the fields changes within an episode."""
    return any(np.ptp(values, axis=0).any() for values in logs.values(fields))


def _may_move(command: Field, state: Field) -> bool:
    """Return whether the units, where both are known, are the same but for a time."""
    return "1" in (command.unit, state.unit) or command.unit.removesuffix("/s") == state.unit


def _length(filled: list[Field | None]) -> int:
    return filled.index(None) if None in filled else len(filled)


def _typical(episodes: list[Floats]) -> tuple[Floats, float]:
    """Return the end (D,) of the episode whose way from its start is the median, and a tenth of the way.

    Where that ends as it began, it is a tenth of the farthest way that an episode went, or else of how far
    episodes lie apart.
    """
    ways = [float(np.linalg.norm(values[-1] - values[0])) for values in episodes]
    typical = int(np.argsort(ways)[len(ways) // 2])
    farthest = max(float(np.linalg.norm(values - values[0], axis=1).max()) for values in episodes)
    apart = float(np.linalg.norm(np.ptp(np.concatenate(episodes), axis=0)))
    return episodes[typical][-1], (ways[typical] or farthest or apart) / 10


def _numbers(values: Iterable[float] | Floats, brackets: str = "[]") -> str:
    """Return a list, or a tuple, as code."""
    inside = [repr(significant(value)) for value in values]
    comma = "," if brackets == "()" and len(inside) == 1 else ""
    return f"{brackets[0]}{', '.join(inside)}{comma}{brackets[1]}"


def significant(value: float) -> float:
    """Return a number of the logs as it is written down: to nine digits, as exact as float32."""
    return float(f"{value:.9g}") + 0.0


def texts(values: Iterable[str]) -> str:
    """Return a tuple as code."""
    inside = [json.dumps(value, ensure_ascii=False) for value in values]
    return f"({', '.join(inside)}{',' if len(inside) == 1 else ''})"
