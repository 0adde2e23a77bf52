"""Rows that do not belong together: states that were written twice, and actions of other rows."""

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.numbers import as_rows
from astra_data.dataset.checkup.finding import Finding
from astra_data.dataset.columns import ACTION, STATE, Episode

MOST_REPEATED = 0.05
"""Share of the steps above which states that repeat the row before, between others that move, are many."""
LONGEST = 5
"""Rows in a row that repeat a state; a robot that stands still does so for longer."""
LAGS = range(-3, 4)
"""Rows between a step and the action that is tried as its cause."""
CLEAR = 0.2
"""By how much more of the variance of steps another row's action explains, where rows are off."""
MOST_STEPS = 2**13
"""Steps that a shift is estimated from."""


class Repeats:
    """Counts the states that repeat the row before to the bit while the robot moves."""

    def __init__(self) -> None:
        self._steps = self._repeated = 0

    def add(self, episode: Episode) -> None:
        """Look at the next episode."""
        if STATE not in episode.columns:
            return
        state = as_rows(episode.columns[STATE])
        moves = np.flatnonzero((state[1:] != state[:-1]).any(axis=1))
        runs = np.diff(moves) - 1
        self._repeated += int(runs[runs <= LONGEST].sum())
        self._steps += max(len(state) - 1, 0)

    def findings(self) -> list[Finding]:
        """Tell where many rows repeat the one before."""
        if self._repeated <= MOST_REPEATED * self._steps:
            return []
        what = (
            f"{self._repeated} of {self._steps} steps repeat the state of the row before to the bit, between "
            "steps that move: the log is faster than its sensor, or rows were written twice"
        )
        return [Finding("warning", what, "leave out the repeated rows, correct `fps`, and import again")]


class Shift:
    """Finds whether steps follow from actions of other rows better than from their own."""

    def __init__(self) -> None:
        self._rows: list[tuple[Floats, Floats]] = []
        self._steps = 0

    def add(self, episode: Episode) -> None:
        """Take the next episode, until there are enough steps."""
        columns = episode.columns
        if self._steps < MOST_STEPS and len(episode) > len(LAGS) and {STATE, ACTION} <= columns.keys():
            state, action = (as_rows(columns[name])[:MOST_STEPS].astype(float) for name in (STATE, ACTION))
            self._rows.append((state, action))
            self._steps += len(state)

    def explained(self) -> Floats:
        """Return how much of the variance of steps the action of each of `LAGS` explains beside the state."""
        widest = max(LAGS)
        inner = [slice(widest, len(state) - 1 - widest) for state, _ in self._rows]
        before = np.concatenate([state[rows] for (state, _), rows in zip(self._rows, inner, strict=True)])
        steps = np.concatenate(
            [np.diff(state, axis=0)[rows] for (state, _), rows in zip(self._rows, inner, strict=True)]
        )
        steps = steps[:, np.ptp(steps, axis=0) > 0]
        if not steps.size:
            return np.zeros(len(LAGS))
        steps = (steps - steps.mean(axis=0)) / steps.std(axis=0)
        known = np.column_stack([np.ones(len(before)), before])
        shares = []
        for lag in LAGS:
            parts = [action[widest + lag : len(action) - 1 - widest + lag] for _, action in self._rows]
            design = np.column_stack([known, np.concatenate(parts)])
            design /= np.maximum(np.abs(design).max(axis=0), 1e-30)
            rest = steps - design @ np.linalg.lstsq(design, steps)[0]
            shares.append(1 - float((rest**2).mean()))
        return np.array(shares)

    def findings(self) -> list[Finding]:
        """Tell by how many rows actions are off, if they are."""
        width = sum(part.shape[1] for part in self._rows[0]) if self._rows else 0
        if self._steps < 20 * (width + len(LAGS)) or not any(
            np.ptp(state, axis=0).any() for state, _ in self._rows
        ):
            return []
        shares = self.explained()
        best, own = LAGS[int(shares.argmax())], float(shares[LAGS.index(0)])
        if shares.max() - own < CLEAR:
            return []
        off = f"{abs(best)} row{'s' if abs(best) > 1 else ''}"
        explains = f"explains {shares.max():.0%} of their variance, that of their own row {own:.0%}"
        if best > 0:
            what = f"steps follow from the action {off} later, which {explains}: actions are in later rows"
            return [Finding("warning", what, f"move the actions up by {off} and import again")]
        what = f"steps follow from the action {off} earlier, which {explains}: commands act late"
        advice = f"move the actions down by {off} and import again, unless the robot has that delay"
        return [Finding("note", what, advice)]
