"""The batched environment: B environments stepped at once, whose rows the caller resets.

    observation = env.reset()                    (B, O)
    step = env.step(action)                      action (B, A) -> Step, each field (B, ...)
    observation = env.reset(step.terminated)     restarts the finished rows only

`step.observation` is always the state that the action led to, also in the last step of an episode, so that
learners can bootstrap from it. No row restarts by itself.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor


@dataclass(frozen=True)
class Step:
    """The outcome of one batched step.

    Attributes:
        observation: (B, O) float32, after the action.
        reward: (B,) float32.
        terminated: (B,) bool, the episode ended: the value of the next state is 0.
        success: (B,) bool, the goal was reached in this step.
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
        """Restart the rows in `mask` (B,), by default all; return observations (B, O)."""
        ...

    def step(self, action: Tensor) -> Step:
        """Apply `action` (B, A) to every row."""
        ...


class TargetEnv(BatchedEnv, Protocol):
    """B target environments.

    Attributes:
        goal: (B, G) float32.
    """

    goal: Tensor

    @property
    def state(self) -> Tensor:
        """The full target states, (B, S) float32."""
        ...

    @property
    def position(self) -> Tensor:
        """True positions of robots, then of their balls where there are any, (B, 2) or (B, 4) float32, m."""
        ...

    @property
    def failed(self) -> Tensor:
        """Which robots failed in their last step, (B,) bool."""
        ...

    @property
    def wall_contact(self) -> Tensor:
        """Which robots touched a wall in their last step, (B,) bool."""
        ...

    def reseed(self, seed: int) -> None:
        """Restart the random numbers at `seed`."""
        ...

    def reset_to(self, rows: NDArray[np.intp], state: NDArray[np.float64]) -> None:
        """Set the robots `rows` (n,) to `state` (n, S)."""
        ...

    def step(self, action: Tensor, active: Tensor | None = None) -> Step:
        """Apply `action` (B, A); rows outside `active` (B,) stay as they are."""
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """Return what `load_state_dict` needs to continue from here; later random draws may differ."""
        ...

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        ...


def rows_in(mask: Tensor | None, num_envs: int) -> NDArray[np.intp]:
    """Return the rows (n,) in `mask` (B,), or all B of `num_envs` without one."""
    return np.arange(num_envs) if mask is None else np.flatnonzero(mask.numpy())
