"""CSV logs, cut into episodes, and what their fields are taken for."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astra_data.exchange.field_names import HEADING, TURN_RATE, Role

Floats = NDArray[np.float64]
RATE_HZ = 10
"""Of logs without a time."""


@dataclass(frozen=True)
class Field:
    """One field of the logs: `name` there and `short` here; `scale` takes its values to `unit`."""

    name: str
    role: Role
    short: str
    unit: str
    scale: float
    why: str

    @property
    def is_turn_rate(self) -> bool:
        """Whether a heading changes by it."""
        if self.unit == "rad/s" and HEADING.fullmatch(self.short):
            return True
        return self.unit in ("1", "rad/s") and TURN_RATE.fullmatch(self.short) is not None

    @property
    def taken_for(self) -> str:
        """Its role, with the name of a state or command."""
        return f"{self.role} {self.short}" if self.role in ("state", "command") else self.role


@dataclass(frozen=True)
class Logs:
    """Logs and what their fields are.

    Attributes:
        fields: in the order of the logs.
        episodes: of each, the scaled values (T,) by a field's name, of the rows with a number in each state
            and command.
        left_out: rows without one: how many by the name of the state or command.
    """

    fields: tuple[Field, ...]
    episodes: tuple[dict[str, Floats], ...]
    left_out: dict[str, int]

    @property
    def rate(self) -> int:
        """Rows a second; `RATE_HZ` where the logs have no time."""
        for field in self.of("time"):
            steps = np.concatenate([np.diff(episode[field.name]) for episode in self.episodes])
            return max(1, round(1 / float(np.median(steps))))
        return RATE_HZ

    def of(self, role: Role) -> tuple[Field, ...]:
        """Return the fields with a role."""
        return tuple(field for field in self.fields if field.role == role)

    def values(self, fields: Sequence[Field]) -> list[Floats]:
        """Return the values (T, len(fields)) of each episode."""
        return [np.stack([episode[field.name] for field in fields], axis=-1) for episode in self.episodes]
