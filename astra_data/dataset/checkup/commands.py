"""Which commands were given: how long each was held, and how often they were at the edge of their range."""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from astra_data.core.numbers import as_rows
from astra_data.dataset.checkup.finding import SHOWN, Finding, channels, labels
from astra_data.dataset.columns import ACTION, Array, Column, Episode

SATURATED = 0.2
"""Share of steps at the edge of the range above which a command is saturated."""
DISCRETE = 8
"""A command with at most so many different values is a choice among them and has no edge."""


class GivenCommands:
    """The commands of a dataset, whose actions are `column` (T, A)."""

    def __init__(self, column: Column, fps: int) -> None:
        self._column, self._fps = column, fps
        # Per command the smallest and the largest value, and how many steps have it.
        self._edges = np.array([[np.inf], [-np.inf]]).repeat(column.size, axis=1)
        self._at_edge: NDArray[np.int64] = np.zeros((2, column.size), np.int64)
        self._values: list[set[float]] = [set() for _ in range(column.size)]
        self._held: Counter[int] = Counter()
        self._steps = 0

    def add(self, episode: Episode) -> None:
        """Count the commands of the next episode."""
        actions = as_rows(episode.columns[ACTION])
        self._steps += len(actions)
        for side, extreme in enumerate((actions.min(axis=0), actions.max(axis=0))):
            beyond = extreme < self._edges[side] if side == 0 else extreme > self._edges[side]
            self._edges[side][beyond] = extreme[beyond]
            self._at_edge[side][beyond] = 0
            self._at_edge[side] += (actions == self._edges[side]).sum(axis=0)
        for values, found in zip(self._values, actions.T, strict=True):
            if len(values) <= DISCRETE:
                values.update(np.unique(found)[: DISCRETE + 1].tolist())
        self._held.update(held_steps(actions).tolist())

    @property
    def edge_shares(self) -> NDArray[np.float64]:
        """Share of steps at the edge of the range, of each command (A,); 0 where it is a choice of few."""
        shares: NDArray[np.float64] = self._at_edge.sum(axis=0) / self._steps
        shares[[len(values) <= DISCRETE for values in self._values]] = 0.0
        return shares

    def held_s(self, quantile: float) -> float:
        """Return for how long a command is held, in s: a quantile over commands."""
        steps = np.array(sorted(self._held))
        count = np.cumsum([self._held[length] for length in steps.tolist()])
        return float(steps[np.searchsorted(count, quantile * count[-1])] / self._fps)

    def __str__(self) -> str:
        """Say how long commands are held and how often they are at the edge of their range."""
        names, edge_shares = labels(self._column), self.edge_shares
        most = np.sort(np.argsort(-edge_shares, kind="stable")[:SHOWN])
        shares = ", ".join(f"{names[index]} {100 * edge_shares[index]:.1f} %" for index in most)
        shares += f" and {len(names) - SHOWN} less often" if len(names) > SHOWN else ""
        return (
            f"held {self.held_s(0.5):.3g} s (median), {self.held_s(0.95):.3g} s (95 %); steps at the edge of "
            f"the range: {shares}"
        )

    def findings(self) -> list[Finding]:
        """Tell which commands are saturated."""
        saturated = np.flatnonzero(self.edge_shares > SATURATED)
        if not len(saturated):
            return []
        names = channels(self._column, saturated.tolist())
        worst = self.edge_shares.max()
        return [
            Finding(
                "note",
                f"commands at the edge of their range in up to {100 * worst:.0f} % of steps, {names}",
                "values in between are rarer in the data: compare the range with what the robot follows "
                "(`clip` in the mapping), or record gentler commands",
            )
        ]


def held_steps(actions: Array) -> NDArray[np.int64]:
    """Return the lengths of the runs of equal rows in `actions` (T, A), without one that the end cuts off.

    A single run is returned though it is cut off.
    """
    changes = np.flatnonzero((actions[1:] != actions[:-1]).any(axis=1)) + 1
    return np.diff(np.concatenate([[0], changes if len(changes) else [len(actions)]]))
