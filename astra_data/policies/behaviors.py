"""Behaviors: controllers that act in the target while data is collected."""

from typing import Annotated, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import AfterValidator
from torch import Tensor

from astra_data.core.config import NotNegative, in_order
from astra_data.core.seeding import derive, generator
from astra_data.policies.running_policy import RunningPolicy
from astra_data.worlds.task import Task

_FORESIGHT_S = 1.0
_CHOICES = 16
"""Random commands to choose one from that stays clear of walls."""

HoldTimes = Annotated[tuple[NotNegative, NotNegative], AfterValidator(in_order)]
"""The shortest and the longest time for which a random command is held."""


def held_steps(hold_s: HoldTimes, timestep_s: float) -> tuple[int, int]:
    """Return the fewest and the most control steps for which a command is held."""
    shortest, longest = (max(1, round(seconds / timestep_s)) for seconds in hold_s)
    return shortest, longest


class Behavior(Protocol):
    """Acts on B robots."""

    def start(self, rows: range, seed: int) -> None:
        """Begin new episodes, numbered `rows`, of as many robots; `seed` decides everything random."""
        ...

    def act(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return actions (B, A) for target states (B, S) and goals (B, G)."""
        ...


class WallWatch:
    """Predicts with the abstract simulator how close to walls commands lead within a second."""

    def __init__(self, task: Task, clearance_m: float) -> None:
        """Keep robots `clearance_m` away from the walls of the task's maze."""
        self.clearance_m = clearance_m
        self._task, self._maze = task, task.maze

    def clearance(self, state: Tensor, commands: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the least clearance in m (B, K) if `commands` (B, K, A) are held from `state` (B, S)."""
        task, (count, choices, _) = self._task, commands.shape
        simulator = task.simulator(count * choices)
        simulator.reset_to(task.abstraction(state).repeat_interleave(choices, dim=0))
        action = torch.from_numpy(commands).float().flatten(0, 1)
        nearest = np.full((count, choices), np.inf)
        for _ in range(round(_FORESIGHT_S / task.timestep_s)):
            position = simulator.step(action)[:, :2].double().numpy()
            nearest = np.minimum(nearest, self._maze.clearance(position).reshape(count, choices))
        return nearest


class RandomCommands:
    """Commands from U[-1, 1] per axis, each held for a random number of steps."""

    def __init__(self, action_size: int, hold_steps: tuple[int, int], watch: WallWatch | None = None) -> None:
        """Hold commands (A,) for `hold_steps` (fewest, most), or until `watch` predicts a wall."""
        self._size = action_size
        self._hold_steps = hold_steps
        self._watch = watch

    def start(self, rows: range, seed: int) -> None:
        """Begin new episodes of as many robots as `rows`."""
        self._rng = generator(seed, "behavior")
        self._command = np.zeros((len(rows), self._size))
        self._left = np.zeros(len(rows), dtype=int)

    def act(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return commands (B, A); goals are ignored, and so are states unless walls are watched for."""
        over = self._left == 0
        if self._watch is not None:
            over |= self._watch.clearance(state, self._command[:, None])[:, 0] < self._watch.clearance_m
        due = np.flatnonzero(over)
        self._command[due] = self._drawn(state, due)
        self._left[due] = self._times(len(due))
        self._left -= 1
        return torch.from_numpy(self._command).float()

    def _drawn(self, state: Tensor, due: NDArray[np.intp]) -> NDArray[np.float64]:
        """Draw commands (n, A) for the robots `due` (n,).

        With a watch, take the first of 16 that stays clear of walls, or else the clearest.
        """
        if self._watch is None:
            return self._proposed(due, 1)[:, 0]
        choices = self._proposed(due, _CHOICES)
        clearance = self._watch.clearance(state[due], choices).clip(max=self._watch.clearance_m)
        return np.asarray(choices[np.arange(len(due)), clearance.argmax(axis=1)])

    def _proposed(self, due: NDArray[np.intp], choices: int) -> NDArray[np.float64]:
        """Draw `choices` commands (n, K, A) for each of the robots `due` (n,)."""
        return self._rng.uniform(-1.0, 1.0, (len(due), choices, self._size))

    def _times(self, count: int) -> NDArray[np.int64]:
        """Draw for how many steps `count` commands are held, (count,)."""
        fewest, most = self._hold_steps
        return self._rng.integers(fewest, most + 1, count)


class StressCommands(RandomCommands):
    """Commands that seek failures: at the bounds, half of them the reverse of the one before.

    Times of holding are log-uniform, so that short and long ones are alike frequent.
    """

    def _proposed(self, due: NDArray[np.intp], choices: int) -> NDArray[np.float64]:
        drawn = super()._proposed(due, choices)
        drawn /= np.abs(drawn).max(axis=-1, keepdims=True)
        before = self._command[due, None]
        is_reversed = (self._rng.random((len(due), choices, 1)) < 0.5) & before.any(axis=-1, keepdims=True)
        return np.where(is_reversed, -before, drawn)

    def _times(self, count: int) -> NDArray[np.int64]:
        fewest, most = self._hold_steps
        drawn = np.exp(self._rng.uniform(np.log(fewest), np.log(most + 1), count))
        return drawn.astype(np.int64).clip(fewest, most)


class PolicyBehavior:
    """A policy that draws its actions from its distribution, as it does in training."""

    def __init__(self, running: RunningPolicy) -> None:
        self._running = running

    def start(self, rows: range, seed: int) -> None:
        """Begin new episodes of as many robots as `rows`."""
        self._running.start(len(rows), torch.Generator().manual_seed(derive(seed, "behavior")))

    def act(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return actions (B, A) for target states (B, S) and goals (B, G)."""
        return self._running.act(state, goal)


class MixedBehavior:
    """A policy on a part of the robots, random commands on the others."""

    def __init__(self, policy: Behavior, random: Behavior, share: float) -> None:
        """Let `random` act on a `share` of all episodes, spread evenly: the first n have it as well."""
        self._policy, self._random, self._share = policy, random, share

    def start(self, rows: range, seed: int) -> None:
        """Begin the episodes `rows`."""
        self._policy.start(rows, seed)
        self._random.start(rows, seed)
        episodes = torch.arange(rows.start, rows.stop + 1, dtype=torch.float64)
        before = torch.floor(episodes * self._share + 1e-9)
        self.is_random = (before.diff() > 0).unsqueeze(1)

    def act(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return actions (B, A) for target states (B, S) and goals (B, G)."""
        return torch.where(self.is_random, self._random.act(state, goal), self._policy.act(state, goal))
