"""How well a guessed abstract simulator predicts the logs that it was guessed from."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.exchange.logs import Logs

JUDGED_STEPS = 10
"""After so many steps a simulator should be better than nothing."""
CLEARLY = 1.05
"""Errors that are larger by less than this factor may be chance."""


class Kind(Protocol):
    """An abstract simulator of D states and A commands, without a file of its own yet."""

    @property
    def logs(self) -> Logs:
        """What was recorded."""
        ...

    @property
    def names(self) -> Sequence[str]:
        """What the states are called."""
        ...

    @property
    def angles(self) -> Sequence[bool]:
        """Which of the states are angles, of which whole turns do not count."""
        ...

    def states(self) -> list[Floats]:
        """Return the states (T, D) of each episode."""
        ...

    def step(self, state: Floats, command: Floats) -> Floats:
        """Return where states (B, D) land by commands (B, A)."""
        ...


def badly_predicted(kind: Kind) -> list[str]:
    """Return the names of the states that standing still predicts clearly better after `JUDGED_STEPS`."""
    simulated, still = errors(kind, JUDGED_STEPS)
    worse = simulated > CLEARLY * still
    return [name for name, is_worse in zip(kind.names, worse, strict=True) if is_worse]


def judged_steps(episodes: Sequence[Floats]) -> int:
    """Return `JUDGED_STEPS`, or 1 where no episode is as long; over one step, what lags looks like a rate."""
    return JUDGED_STEPS if any(len(values) > JUDGED_STEPS for values in episodes) else 1


def errors(kind: Kind, steps: int) -> tuple[Floats, Floats]:
    """Return the mean errors (D,) of states after `steps` of recorded commands, and those of standing still.

    Each row of the logs is a start. They are nan where no episode is longer than `steps`.
    """
    ends, starts, wanted = [], [], []
    for states, commands in zip(kind.states(), kind.logs.values(kind.logs.of("command")), strict=True):
        there = first = states[: max(0, len(states) - steps)]
        for step in range(steps):
            there = kind.step(there, commands[step : step + len(there)])
        ends.append(there)
        starts.append(first)
        wanted.append(states[steps:])
    return _mean_apart(kind, ends, wanted), _mean_apart(kind, starts, wanted)


def _mean_apart(kind: Kind, found: Sequence[Floats], wanted: Sequence[Floats]) -> Floats:
    apart = np.concatenate(found) - np.concatenate(wanted)
    apart = np.where(kind.angles, np.arctan2(np.sin(apart), np.cos(apart)), apart)
    return np.abs(apart).mean(axis=0) if len(apart) else np.full(apart.shape[1], np.nan)
