"""Interfaces of abstract simulators, a user's `Simulator` among them, and of batched environments."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Floats
from astra_data.core.lazy import Tensor
from astra_data.dataset.columns import Column


class AbstractSimulator(Protocol):
    """B abstract states that can be set and stepped, which datasets can be paired with."""

    @property
    def state(self) -> Tensor:
        """The present states, (B, X) float32."""

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set `rows` (n,), by default all, to `state` (n, X)."""

    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return the new states (B, X)."""

    @property
    def parameters(self) -> Mapping[str, float]:
        """Numbers or texts that a dataset paired with this simulator records about it."""


class Simulator(AbstractSimulator, Protocol):
    """A simulator from a file of the user's, with its map from target states; built as `Own(num_envs)`.

    Example:
        >>> import torch
        >>> from astra_data import Column
        >>> class Cart:
        ...     abstract_state = Column("abstract.state", size=2, names=("x", "y"))
        ...     parameters = {"timestep_s": 0.05}
        ...
        ...     def __init__(self, num_envs):
        ...         self.state = torch.zeros(num_envs, 2)
        ...
        ...     @staticmethod
        ...     def abstraction(state):
        ...         return state[:, :2]
        ...
        ...     def reset_to(self, state, rows=None):
        ...         self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)
        ...
        ...     def step(self, action):
        ...         self.state = self.state + 0.05 * action
        ...         return self.state
        >>> Cart(3).step(torch.ones(3, 2)).shape
        torch.Size([3, 2])
    """

    abstract_state: Column  # of abstract states, with names, units, frames and roles

    @staticmethod
    def abstraction(state: Any) -> Any:  # noqa: ANN401 - numpy arrays of either precision
        """Map target states (B, S) to abstract states (B, X), numpy in, numpy out."""


class TaskSimulator(AbstractSimulator, Protocol):
    """The abstract simulator of a task: corrections may move its states, and its parameters be set row by row."""

    @property
    def blocked(self) -> Tensor:
        """Which states (B,) were stopped at the edge of the free space in the last step, bool."""

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move from `before` as far toward `landed`, both (B, X), as there is room, or draw where; return it (B, X)."""

    def vary(self, parameters: Mapping[str, Tensor]) -> None:
        """Use `parameters` by name, (B, 1) each, from the next step on; those without effect are ignored."""


@runtime_checkable
class RememberingSimulator(Protocol):
    """A simulator whose next steps depend on more than its states."""

    memory: Tensor  # that they, and corrections, depend on, (B, M); `reset_to` of given rows begins theirs anew


@dataclass(frozen=True)
class Step:
    """The outcome of one batched step."""

    observation: Tensor  # (B, O) float32, after the action, also of the last step of an episode: no row restarts itself
    reward: Tensor  # (B,) float32
    terminated: Tensor  # (B,) bool, the episode ended: the value of the next state is 0
    success: Tensor  # (B,) bool, the goal was reached in this step


class BatchedEnv(Protocol):
    """B environments that learners can train in."""

    num_envs: int
    observation_size: int
    action_size: int

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Restart the rows in `mask` (B,), by default all; return observations (B, O)."""

    def step(self, action: Tensor) -> Step:
        """Apply `action` (B, A) to every row."""


class TargetEnv(BatchedEnv, Protocol):
    """B target environments, with goals (B, G) float32."""

    goal: Tensor

    @property
    def state(self) -> Tensor:
        """The full target states, (B, S) float32."""

    @property
    def position(self) -> Tensor:
        """True positions of robots, then of their balls where there are any, (B, 2) or (B, 4) float32, m."""

    @property
    def failed(self) -> Tensor:
        """Which robots failed in their last step, (B,) bool."""

    @property
    def wall_contact(self) -> Tensor:
        """Which robots touched a wall in their last step, (B,) bool."""

    def reseed(self, seed: int) -> None:
        """Restart the random numbers at `seed`."""

    def reset_to(self, rows: NDArray[np.intp], state: Floats) -> None:
        """Set the robots `rows` (n,) to `state` (n, S)."""

    def step(self, action: Tensor, active: Tensor | None = None) -> Step:
        """Apply `action` (B, A); rows outside `active` (B,) stay as they are."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return what `load_state_dict` needs to continue from here; later random draws may differ."""

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""


def rows_in(mask: Tensor | None, num_envs: int) -> NDArray[np.intp]:
    """Return the rows (n,) in `mask` (B,), or all B of `num_envs` without one."""
    return np.arange(num_envs) if mask is None else np.flatnonzero(mask.numpy())
