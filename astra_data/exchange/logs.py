"""CSV logs, cut into episodes, and what their fields are taken for."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.exchange.field_names import HEADING, TURN_RATE, Role

RATE_HZ = 10
"""Of logs without a time."""
_EVEN = 0.005
"""Error of a rate that is taken for a whole number."""


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
    def plain(self) -> str:
        """What patterns of names look at: `short` in small letters, digits and single underscores."""
        return re.sub(r"[\W_]+", "_", self.short.lower()).strip("_") or self.short

    @property
    def is_turn_rate(self) -> bool:
        """Whether a heading changes by it."""
        if self.unit == "rad/s" and HEADING.fullmatch(self.plain):
            return True
        return self.unit in ("1", "rad/s") and TURN_RATE.fullmatch(self.plain) is not None

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
        cut_off: the files whose last line is cut off, which is left out.
    """

    fields: tuple[Field, ...]
    episodes: tuple[dict[str, Floats], ...]
    left_out: dict[str, int]
    cut_off: tuple[str, ...] = ()

    @property
    def rate(self) -> int:
        """Whole rows a second, the nearest to the usual ones; `RATE_HZ` where the logs have no time."""
        for usual in self._rates[:1]:
            below = max(1, math.floor(usual))
            return min(below, below + 1, key=lambda whole: abs(usual / whole - 1))
        return RATE_HZ

    @property
    def recorded_rate(self) -> float:
        """Rows a second by the times, usual or in the mean: the one that is nearer to `rate`."""
        return min(self._rates, key=lambda recorded: abs(recorded / self.rate - 1), default=float(RATE_HZ))

    @property
    def rate_error(self) -> float:
        """By how much 1 / `rate` is too long for a recorded step, as a share of it."""
        return self.recorded_rate / self.rate - 1

    @property
    def uneven(self) -> str:
        """That the rate is no whole number, and what to do; nothing where it is one within `_EVEN`."""
        if abs(self.rate_error) < _EVEN:
            return ""
        off = f"{abs(self.rate_error):.1%} too {'long' if self.rate_error > 0 else 'short'}"
        return (
            f"the logs have {self.recorded_rate:.4g} rows per second, not a whole number: TIMESTEP_S is "
            f"{off}; resample them to {self.rate} rows per second"
        )

    @cached_property
    def _rates(self) -> tuple[float, ...]:
        """The usual rows a second, and their mean without gaps, as in an import; none without a time."""
        for field in self.of("time"):
            steps = np.concatenate([np.diff(episode[field.name]) for episode in self.episodes])
            usual = float(np.median(steps))
            regular = steps[(steps > 0) & (steps <= 5 * usual)]
            return 1 / usual, 1 / float(regular.mean())
        return ()

    @property
    def failed(self) -> list[bool]:
        """Whether a field says of each episode that it fails; never without such a field."""
        flags = self.of("failure")
        return [any(bool(episode[field.name].any()) for field in flags) for episode in self.episodes]

    @property
    def still(self) -> str:
        """Which commands never change, and what that means; nothing where all do."""
        fields = self.of("command")
        given = np.concatenate(self.values(fields))
        named = [
            f"{field.short} is {values[0]:g}"
            for field, values in zip(fields, given.T, strict=True)
            if not np.ptp(values)
        ]
        what = "it does" if len(named) == 1 else "they do"
        return f"{' and '.join(named)} in all rows: no simulator can learn what {what}" if named else ""

    def of(self, role: Role) -> tuple[Field, ...]:
        """Return the fields with a role."""
        return tuple(field for field in self.fields if field.role == role)

    def values(self, fields: Sequence[Field]) -> list[Floats]:
        """Return the values (T, len(fields)) of each episode."""
        return [np.stack([episode[field.name] for field in fields], axis=-1) for episode in self.episodes]
