"""What the planar abstract simulators have in common: states among walls, that can be set and corrected."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from astra_data.worlds.plane.free_space import FreeSpace
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.variation import Variation


class PlanarStates:
    """B planar states (B, X) that begin with x, y, vx, vy of a disc among the walls of a maze, in m and m/s.

    Attributes:
        state: (B, X) float32.
        free: where the disc's centre may be.
        blocked: (B,) bool, a wall stopped the disc in the last step, or in its correction.
    """

    def __init__(self, maze: Maze, num_envs: int, state_size: int, *, radius_m: float, device: str) -> None:
        self.free = FreeSpace.of_maze(maze, radius_m=radius_m, device=device)
        self.num_envs = num_envs
        self.state = torch.zeros(num_envs, state_size, device=device)
        self.blocked = torch.zeros(num_envs, dtype=torch.bool, device=device)

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, X)."""
        # New tensors, so that those handed out earlier stay as they were.
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)
        if rows is not None:
            self.blocked = self.blocked.index_fill(0, rows, False)

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Slide the discs from `before` towards `landed`, both (B, X); all else is that of `landed`.

        What the step did itself still counts as a touch: otherwise policies lean on walls that the correction
        draws them away from.
        """
        position, stopped = self.free.slide(before[:, :2], landed[:, :2])
        self.blocked = self.blocked | stopped
        self.reset_to(torch.cat([position, landed[:, 2:]], dim=-1))
        return self.state


class VariedStates(PlanarStates, ABC):
    """The same with parameters that differ from row to row, and sensors between the states and who sees them.

    Attributes:
        variation: the ranges of the parameters. parameters: (B, P), in the order of its `names`.
        state: what is shown, (B, X) float32. true_state: what is so, likewise.
    """

    def __init__(
        self,
        maze: Maze,
        num_envs: int,
        state_size: int,
        variation: Variation,
        *,
        radius_m: float,
        device: str,
    ) -> None:
        super().__init__(maze, num_envs, state_size, radius_m=radius_m, device=device)
        self.variation = variation
        self.true_state = self.state
        self.parameters = variation.draw(num_envs, device)

    @abstractmethod
    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return what is shown of the new state (B, X)."""

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, X)."""
        super().reset_to(state, rows)
        self.true_state = state.clone() if rows is None else self.true_state.index_copy(0, rows, state)

    def show(self, widths: list[Tensor]) -> Tensor:
        """Show the true states with uniform noise of half `widths` (B,), one for each two entries.

        Noise is drawn from torch's global generator. Returns what is shown, (B, X).
        """
        shown = torch.rand_like(self.true_state) * 2.0 - 1.0
        self.state = self.true_state + shown * torch.stack(widths, dim=-1).repeat_interleave(2, dim=-1)
        return self.state
