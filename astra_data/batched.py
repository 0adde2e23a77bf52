"""What a learner needs of a world: B environments stepped at once, rows reset when the learner says so.

    observation = env.reset()                    (B, O)
    step = env.step(action)                      action (B, A) -> Step, each field (B, ...)
    observation = env.reset(step.terminated)     only the finished rows start anew

`step.observation` is always what the action led to, also in the last step of an episode, so that learners
can bootstrap from it; nothing restarts behind the caller's back.
"""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor


@dataclass(frozen=True)
class Step:
    """The outcome of one batched step.

    Attributes:
        observation: (B, O) float32, after the action.
        reward: (B,) float32.
        terminated: (B,) bool, the task ended: no value beyond it.
        success: (B,) bool, the task was fulfilled in this step.
    """

    observation: Tensor
    reward: Tensor
    terminated: Tensor
    success: Tensor


class BatchedEnv(Protocol):
    """B environments that learners can train in."""

    num_envs: int
    observation_size: int
    action_size: int

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Start the rows in `mask` (B,) anew, by default all; return observations (B, O)."""
        ...

    def step(self, action: Tensor) -> Step:
        """Apply `action` (B, A) to every row."""
        ...
