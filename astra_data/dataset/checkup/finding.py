"""One thing that a check-up found, where, and what to do about it."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from astra_data.core.wording import first_few
from astra_data.dataset.columns import Column

SHOWN = 5
"""Episodes that a line names; further ones are counted."""


@dataclass(frozen=True)
class Finding:
    """One finding of a check-up.

    Attributes:
        severity: "warning" if a grounding would be fitted to something that the robot did not do, "note" if
            it is worth knowing.
        what: what was found.
        advice: what to do.
        episodes: uids of the episodes where it is; empty if it concerns the whole dataset.
    """

    severity: Literal["warning", "note"]
    what: str
    advice: str
    episodes: tuple[int, ...] = ()

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
    options = " ".join(f"--episode {uid}" for uid in uids[:SHOWN])
    return f"astra-data delete {called} {options}" + (" ..." if len(uids) > SHOWN else "")


def labels(column: Column) -> list[str]:
    """Return a name for each value of `column`."""
    return [column.name] if column.size == 1 and not column.names else list(column.labels)


def channels(column: Column, indices: Sequence[int]) -> str:
    """Name the values `indices` of `column`: "x, y of observation.state"."""
    if column.size == 1:
        return column.name
    names = labels(column)
    return f"{', '.join(names[index] for index in indices)} of {column.name}"
