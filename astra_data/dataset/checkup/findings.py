"""One thing that a check-up found, where, and what to do about it."""

import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Floats, as_rows
from astra_data.core.naming import first_few
from astra_data.dataset.columns import NEXT_STATE, STATE, Column, Episode

SHOWN = 5
"""Episodes that a line names; further ones are counted."""
ANGLE = re.compile(r"(.+_)?(heading|yaw|theta|psi|roll|pitch|angle|q\d*|joint\d*)")
"""Names of angles."""
TURNS = {"rad": 2 * math.pi, "deg": 360.0}
"""What a full turn is in each unit."""
LARGEST = 4 * math.pi
"""Few robots turn further than twice around."""


@dataclass(frozen=True)
class Finding:
    """What was found, and what to do about it."""

    severity: Literal["warning", "note"]
    """A warning if a grounding would be fitted to something that the robot did not do."""
    what: str
    advice: str
    episodes: tuple[int, ...] = ()
    """Uids of the episodes where it is; empty if it concerns the whole dataset."""

    def __str__(self) -> str:
        """Say it in a line."""
        where = f" ({listed(self.episodes)})" if self.episodes else ""
        return f"{self.severity}: {self.what}{where}: {self.advice}"

    def record(self) -> dict[str, Any]:
        """Return it for JSON, with all its episodes."""
        return asdict(self) | {"episodes": list(self.episodes)}


def listed(uids: Sequence[int]) -> str:
    """Name the first `SHOWN` of the episodes `uids` and count the others."""
    words = "episode " if len(uids) == 1 else "episodes "
    return words + first_few(uids, SHOWN)


def deletion(called: str, uids: Sequence[int]) -> str:
    """Return the command that leaves `uids` out of the dataset `called`; it spells the first `SHOWN`."""
    options = " ".join(f"--without {uid}" for uid in uids[:SHOWN])
    return f"astra-data filter {called} {options}" + (" ..." if len(uids) > SHOWN else "")


def labels(column: Column) -> list[str]:
    """Return a name for each value of `column`."""
    return [column.name] if column.size == 1 and not column.names else list(column.labels)


def channels(column: Column, indices: Sequence[int]) -> str:
    """Name the values `indices` of `column`: "x, y of observation.state"."""
    if column.size == 1:
        return column.name
    names = labels(column)
    return f"{', '.join(names[index] for index in indices)} of {column.name}"


def is_angle(name: str) -> bool:
    """Return whether `name` is one of an angle, as "base.theta" or "Yaw.pos"."""
    short = re.sub(r"[^a-z0-9]+", "_", name.lower())
    return ANGLE.fullmatch(re.sub(r"_(pos|position|rad|deg)$", "", short)) is not None


class Angles:
    """The values in radians of a column."""

    def __init__(self, column: Column) -> None:
        self._column = column
        self._angles = [index for index, unit in enumerate(column.units) if unit == "rad"]
        self._farthest: NDArray[np.float64] = np.zeros(len(self._angles))

    def add(self, episode: Episode) -> None:
        """Look at the next episode."""
        values = as_rows(episode.columns[self._column.name])[:, self._angles]
        self._farthest = np.maximum(self._farthest, np.abs(values).max(axis=0))

    def findings(self, called: str = "") -> list[Finding]:
        """Tell which angles are larger than `LARGEST`."""
        found = np.flatnonzero(self._farthest > LARGEST).tolist()
        if not found:
            return []
        named = channels(self._column, [self._angles[index] for index in found])
        what = f"{named}: up to {self._farthest[found].max():.4g} rad, which is more than two full turns"
        advice = "if these are degrees, set `scale` to 0.0174533 in the mapping and import again"
        return [Finding("warning", what, advice)]


def full_turns(column: Column) -> Floats:
    """Return what a full turn adds to each value of a column, (size,); 0 for values that are no angles."""
    roles = (column.astra or {}).get("role", [""] * column.size)
    turns = [
        TURNS.get(unit, 2 * np.pi if role == "heading" else 0.0)
        for unit, role in zip(column.units, roles, strict=True)
    ]
    return np.array(turns)


def shortest(steps: Floats, turns: Floats) -> Floats:
    """Return `steps` (T, S) less whole `turns` (S,), where these are not 0."""
    angles = turns > 0
    whole = np.rint(np.divide(steps, turns, out=np.zeros_like(steps), where=angles))
    left: Floats = steps - turns * whole
    return left


class Continuity:
    """Compares each step's next state with the state of the row after it, to the bit."""

    def __init__(self) -> None:
        self._steps = self._broken = 0
        self._uids: list[int] = []

    def add(self, episode: Episode) -> None:
        """Compare the steps of the next episode."""
        if NEXT_STATE not in episode.columns or STATE not in episode.columns:
            return
        state, arrived = as_rows(episode.columns[STATE]), as_rows(episode.columns[NEXT_STATE])
        broken = int((arrived[:-1] != state[1:]).any(axis=1).sum())
        self._steps += len(state) - 1
        self._broken += broken
        if broken:
            self._uids.append(episode.uid)

    def findings(self, called: str = "") -> list[Finding]:
        """Tell how many steps do not lead to the row after them."""
        if not self._broken:
            return []
        what = f"steps whose {NEXT_STATE} is not the state of the next row: {self._broken} of {self._steps}"
        advice = (
            "rows are missing, or the columns come from different logs: import again, without "
            f"{NEXT_STATE} in the mapping if each row is the state after the one before"
        )
        return [Finding("warning", what, advice, tuple(self._uids))]
