"""The base of learners that act in an environment: seeded iterations, and checkpoints."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Protocol

import torch
from torch import Tensor

from astra_data.core.seeding import derive
from astra_data.policies.acting import Acting

_ROUNDING = 1e-9
"""Of a sum of shares."""


class Resumable(Protocol):
    """What checkpoints of a training hold, such as a network or an optimizer."""

    def state_dict(self) -> dict[str, Any]:
        """Return all that `load_state_dict` needs."""
        ...

    def load_state_dict(self, state: dict[str, Any], /) -> object:
        """Continue from `state`."""
        ...


class Learner(ABC):
    """A training in progress.

    Every iteration seeds torch from (seed, iteration): a training that resumes from a checkpoint repeats what
    an uninterrupted one would have done, where the environment can be restored.

    Attributes:
        env: the environment. acting: how a policy acts in it.
        total_steps: environment steps at most. steps: those done.
        share: of the training that is done, from 0 to 1, which schedules follow.
        pace: of the training; at 2 it ends after half of the steps that are left.
        rollout_steps: batched steps per iteration.
    """

    def __init__(
        self,
        acting: Acting,
        parts: Mapping[str, Resumable],
        *,
        total_steps: int,
        rollout_steps: int,
        seed: int,
    ) -> None:
        """Prepare to learn.

        Args:
            acting: the environment and the policy's memory.
            parts: all else that learning changes, by name.
            total_steps: environment steps at most.
            rollout_steps: batched steps per iteration.
            seed: of all randomness.
        """
        self.env, self.acting = acting.env, acting
        self.total_steps, self.rollout_steps, self.steps = total_steps, rollout_steps, 0
        self.share, self.pace = 0.0, 1.0
        self._parts, self._seed, self._iteration = parts, seed, 0

    @property
    def done(self) -> bool:
        """Whether the training is over."""
        return self.share >= 1.0 - _ROUNDING

    @property
    def share_left(self) -> float:
        """Share of the training that is not done yet."""
        return 1.0 - self.share

    def iterate(self) -> dict[str, float]:
        """Take `rollout_steps` batched steps and learn.

        Returns:
            the metrics of `Acting`, and the learner's own.

        Raises:
            BadInputError: the training diverged.
        """
        torch.manual_seed(derive(self._seed, f"iteration {self._iteration}"))
        figures = self._iterate()
        taken = self.env.num_envs * self.rollout_steps
        self.steps += taken
        self.share = min(1.0, self.share + self.pace * taken / self.total_steps)
        self._iteration += 1
        return self.acting.figures() | figures

    @abstractmethod
    def _iterate(self) -> dict[str, float]:
        """Take `rollout_steps` batched steps and learn; return metrics."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything but the environment's own state; see `load_state_dict`."""
        progress = {
            "steps": self.steps,
            "share": self.share,
            "iteration": self._iteration,
            "acting": self.acting.state_dict(),
        }
        return {name: part.state_dict() for name, part in self._parts.items()} | progress

    def load_state_dict(self, state: dict[str, Any], observation: Tensor, *, goes_on: bool = True) -> None:
        """Continue from `state`, once the environment is restored and returned `observation` (B, O).

        Where its episodes do not go on, as those of robots that are where they are, new ones begin with it.
        """
        for name, part in self._parts.items():
            part.load_state_dict(state[name])
        self.steps, self.share, self._iteration = state["steps"], state["share"], state["iteration"]
        if goes_on:
            self.acting.load_state_dict(state["acting"], observation)
        else:
            self.acting.observation = observation
            self._cut()

    def _cut(self) -> None:  # noqa: B027 - most keep nothing
        """Let what comes next follow no step that was kept."""
