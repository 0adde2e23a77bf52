"""The abstract simulator of a new robot of any other kind: values that commands move."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.exchange.field_names import HEADING, LENGTH, QUATERNION
from astra_data.exchange.logs import Field, Logs
from astra_data.experiments.kind_errors import errors, judged_steps
from astra_data.experiments.planar_kinds import is_along_body
from astra_data.experiments.written_values import numbers, texts, typical

_SPEED = re.compile(r"^(vel_|velocity_|v|d)(?=[a-z])")


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

    @property
    def template(self) -> str:
        """The file that it is written as."""
        return "turning.py" if any(self.angles) else "direct.py"

    @property
    def simulator(self) -> str:
        """What it is and what moves it, in a few words."""
        moves = zip(self.is_rate, self.moved, self.logs.of("command"), strict=False)
        listed: dict[str, list[str]] = {"change": [], "are where they are put": []}
        for is_rate, state, command in moves:
            listed["change" if is_rate else "are where they are put"].append(
                f"{state.short} by {command.short}"
            )
        clauses = [f"CHECK: {self._without_effect}"] if self._without_effect else []
        clauses += [
            f"values that {what} as commanded: {', '.join(pairs)}" for what, pairs in listed.items() if pairs
        ]
        clauses += [f"{heading} as cosine and sine" for heading in self._headings]
        pairs = zip(self.logs.of("command"), self.moved, strict=False)
        if turning := [command.short for command, at in pairs if is_along_body(command) and _is_place(at)]:
            clauses.append(f"CHECK: {' and '.join(turning)} go along the robot: turn them by its heading")
        if parts := _quaternions(self.logs):
            clauses.append(
                f"{', '.join(field.short for field in parts)} are a quaternion: make yaw of it in φ"
            )
        if self._outside:
            clauses.append(f"{self._outside} not in φ")
        return "; ".join(clauses)

    @property
    def _without_effect(self) -> str:
        """Which commands move nothing, and that they do; nothing where all move a state."""
        idle = [command.short for command in self.logs.of("command")[len(self.moved) :]]
        return f"{' and '.join(idle)} {'has' if len(idle) == 1 else 'have'} no effect" if idle else ""

    @property
    def _outside(self) -> str:
        """Which headings no command moves, and `is` or `are`; nothing where there is none."""
        fields = [field for field in self.logs.of("state") if field not in self.moved]
        names = [field.short for field in fields if HEADING.fullmatch(field.plain)]
        return f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'}" if names else ""

    @property
    def names(self) -> tuple[str, ...]:
        """What the states are called."""
        return tuple(field.short for field in self.moved)

    @cached_property
    def angles(self) -> tuple[bool, ...]:
        """Which of the states are headings that go round in the logs: whole turns do not count."""
        spans = np.ptp(np.concatenate(self.states()), axis=0).tolist()
        return tuple(
            field.unit == "rad" and HEADING.fullmatch(field.plain) is not None and span > math.pi
            for field, span in zip(self.moved, spans, strict=True)
        )

    @property
    def _headings(self) -> list[str]:
        return [name for name, is_angle in zip(self.names, self.angles, strict=True) if is_angle]

    @classmethod
    def of(cls, logs: Logs) -> Self:
        """Return how it fits: commands move the states of their names, or else the first that may be."""
        parts = _quaternions(logs)
        left = {field.plain: field for field in logs.of("state") if field not in parts}
        moved: list[Field | None] = []
        for command in logs.of("command"):
            names = _names(command, left)
            moved.append(next((left.pop(name) for name in names if name in left), None))
        rest = [field for name, field in left.items() if not _SPEED.match(name)]
        filled = []
        for command, named in zip(logs.of("command"), moved, strict=True):
            field = named or next((one for one in rest if _may_move(command, one)), None)
            rest = [one for one in rest if one is not field]
            filled.append(field)
        found = tuple(field for field in filled[: _length(filled)] if field)
        if not found:
            advice = "make yaw of the quaternion" if parts else "name it as its command, cmd_q1 and q1"
            raise BadInputError(f"found no state that a command could move: {advice}")
        steps = judged_steps(logs.values(found))
        rates, targets = (
            errors(cls(logs, found, (is_rate,) * len(found)), steps)[0] for is_rate in (True, False)
        )
        pairs = zip(found, logs.of("command"), strict=False)
        is_same = np.array([_is_same(state, command) for state, command in pairs])
        return cls(logs, found, tuple(((rates <= targets) & ~is_same).tolist()))

    def states(self) -> list[Floats]:
        """Return the values (T, D) of each episode that commands move."""
        return self.logs.values(self.moved)

    def step(self, state: Floats, command: Floats) -> Floats:
        """Return where states (B, D) land by commands (B, A)."""
        command = command[:, : len(self.moved)]
        return np.where(self.is_rate, state + command / self.logs.rate, command)

    def values(self) -> dict[str, str]:
        """Return what its templates name: states without headings first, and then headings."""
        fields = [field.name for field in self.logs.of("state")]
        order = sorted(range(len(self.moved)), key=lambda number: self.angles[number])
        plain = self.angles.count(False)
        recorded = [values[:, order] for values in self.states()]
        starts = np.array([values[0] for values in recorded])
        episodes = [_shown(values, plain) for values in recorded]
        span = np.ptp(np.concatenate(episodes), axis=0)
        span[span == 0] = 1.0  # of what never moves
        span[plain:] = np.tile(span[plain:].reshape(2, -1).max(axis=0), 2)  # the same of cosine and sine
        goal, close = typical([values / span for values in episodes], self.logs.failed)
        actions, moved = len(self.logs.of("command")), len(self.moved)
        taken = f":{moved}" if order == [*range(moved)] else str(order)
        command = "command" if order == [*range(actions)] else f"command[:, {taken}]"
        rate = f"{'values' if self._headings else 'self.state'} + TIMESTEP_S * {command}"
        is_rate = [self.is_rate[number] for number in order]
        sentence, step = {
            (True,): ("Values that change as they are commanded to.", rate),
            (False,): ("Values that are where they are commanded to be.", command),
            (False, True): (
                "Values that change as they are commanded to, or are where they are commanded to be.",
                f"torch.where(torch.tensor({is_rate}, device=command.device), {rate}, {command})",
            ),
        }[tuple(sorted(set(is_rate)))]
        apart = (
            f"\n        values, cosine, sine = self.state.split({[plain, moved - plain, moved - plain]}, -1)"
            "\n        values = torch.cat([values, torch.atan2(sine, cosine)], -1)"
        )
        before, given = np.arange(moved, dtype=float)[None], np.ones((1, actions))
        after = self.step(before, given)
        return {
            "names": texts(
                [self.names[number] for number in order[:plain]]
                + [f"{heading}_{axis}" for axis in "xy" for heading in self._headings]
            ),
            "units": texts(
                [self.moved[number].unit for number in order[:plain]] + ["1"] * (len(span) - plain)
            ),
            "headings": " and ".join(self._headings),
            "plain": str(plain),
            "apart": apart if "values" in step else "",
            "moved": str(moved),
            "goal": numbers(goal * span, "()"),
            "close": f"{close:.2g}",
            "range": numbers(span, "()"),
            "sentence": sentence,
            "outside": f", in which {self._outside} not" if self._outside else "",
            "effect": f"; {self._without_effect}" if self._without_effect else "",
            "indices": str([fields.index(self.moved[number].name) for number in order]),
            "step": step,
            "actions": str(actions),
            "lows": numbers(starts.min(axis=0)),
            "highs": numbers(starts.max(axis=0)),
            "phi": numbers(episodes[0][0]),
            "before": numbers(_shown(before[:, order], plain)[0]),
            "command": numbers(given[0]),
            "after": numbers(_shown(after[:, order], plain)[0]),
        }


def _shown(values: Floats, plain: int) -> Floats:
    """Return states (T, D) with cosines and sines in place of the headings, which begin at `plain`."""
    around = values[:, plain:]
    return np.concatenate([values[:, :plain], np.cos(around), np.sin(around)], axis=1)


def _quaternions(logs: Logs) -> list[Field]:
    """Return the states that are parts of whole quaternions, such as qw, qx, qy and qz."""
    parts = {field.plain: field for field in logs.of("state") if QUATERNION.fullmatch(field.plain)}
    return [
        field for part, field in parts.items() if {f"{part[:-1]}{axis}" for axis in "wxyz"} <= parts.keys()
    ]


def _names(command: Field, states: Mapping[str, Field]) -> list[str]:
    """Return the plain names of the states that a command moves first of all."""
    named = _SPEED.sub("", command.plain)
    names = [named, command.plain, command.plain.lstrip("u")]
    if not command.is_turn_rate:
        return names
    headings = [name for name in states if HEADING.fullmatch(name) and _may_move(command, states[name])]
    return sorted(headings, key=lambda name: name != named) + names


def _is_same(state: Field, command: Field) -> bool:
    """Return whether a state is what is commanded, and not what it is a rate of."""
    if "1" not in (command.unit, state.unit):
        return command.unit == state.unit
    is_speed = state.is_turn_rate or _SPEED.match(state.plain) is not None
    return is_speed and command.plain == state.plain


def _may_move(command: Field, state: Field) -> bool:
    """Return whether the units, where both are known, are the same but for a time; a turn rate's is."""
    unit = "rad/s" if command.is_turn_rate else command.unit
    return "1" in (unit, state.unit) or unit.removesuffix("/s") == state.unit


def _is_place(state: Field) -> bool:
    return LENGTH.fullmatch(state.plain) is not None


def _length(filled: list[Field | None]) -> int:
    return filled.index(None) if None in filled else len(filled)
