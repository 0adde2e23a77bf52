"""Gymnasium's humanoid, driven by position commands for its hips and knees."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.robots.humanoid import CommandRanges, Humanoids, Locomotion
from astra_data.robots.humanoid.model import COMMANDED, JOINTS, STATE_SIZE
from astra_data.worlds.batched import Step, rows_in


class HumanoidEnv:
    """B humanoids; action: angles of left hip, left knee, right hip, right knee, (B, 4), clipped to ±1.

    State (B, 47): qpos (24) then qvel (23), as in Gymnasium. Observation (B, 45): the state without x and y,
    as Humanoid-v5's begins. Only falling ends an episode.

    Attributes:
        bodies: the humanoids. goal: (B, 0), there is none.
        failed: (B,) bool, at an unhealthy height after the last step.
    """

    observation_size = STATE_SIZE - 2
    action_size = len(COMMANDED)

    def __init__(
        self,
        locomotion: Locomotion,
        num_envs: int,
        *,
        seed: int,
        start_anywhere: bool = False,
        ranges: CommandRanges | None = None,
        num_threads: int | None = None,
    ) -> None:
        """Build B humanoids.

        Args:
            locomotion: reward, ends and starts.
            num_envs: B.
            seed: of starts.
            start_anywhere: false, for there is no maze.
            ranges: joint angles of commands.
            num_threads: physics threads, by default one per core.

        Raises:
            BadInputError: `start_anywhere` is true.
        """
        if start_anywhere:
            raise BadInputError("collect.start: expected 'task' for a humanoid, got 'anywhere'")
        self.locomotion = locomotion
        self.num_envs = num_envs
        self.ranges = ranges or CommandRanges()
        self.bodies = Humanoids(locomotion, num_envs, num_threads=num_threads)
        self.goal = torch.zeros(num_envs, 0)
        self.failed = torch.zeros(num_envs, dtype=torch.bool)
        self.reseed(seed)

    @property
    def state(self) -> Tensor:
        """The full target states, (B, 47) float32."""
        return torch.from_numpy(self.bodies.state).float()

    @property
    def position(self) -> Tensor:
        """Positions of the humanoids, (B, 2) float32 in m."""
        return self.state[:, :2]

    @property
    def wall_contact(self) -> Tensor:
        """All false, for there are no walls: (B,) bool."""
        return torch.zeros(self.num_envs, dtype=torch.bool)

    def reseed(self, seed: int) -> None:
        """Restart the random numbers of starts at `seed`."""
        self._rng = np.random.default_rng(seed)

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Set the humanoids in `mask` (B,), by default all, almost upright and at rest."""
        rows = rows_in(mask, self.num_envs)
        self.reset_to(rows, self.locomotion.draw_starts(self._rng, len(rows)))
        return self._observe()

    def reset_to(self, rows: NDArray[np.intp], state: Floats) -> None:
        """Set the humanoids `rows` (n,) to `state` (n, 47)."""
        self.bodies.reset_to(rows, state)
        self.failed[rows] = False

    def state_dict(self) -> dict[str, Tensor]:
        """Return what `load_state_dict` needs to continue from here; later random draws may differ."""
        physics = self.bodies.physics
        return {
            "physics": torch.from_numpy(physics.state.copy()),
            "measured": torch.from_numpy(physics.measured.copy()),
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state`."""
        self.bodies.physics.state[:] = state["physics"].numpy()
        self.bodies.physics.measured[:] = state["measured"].numpy()

    def step(self, action: Tensor, active: Tensor | None = None) -> Step:
        """Follow the commands `action` (B, 4) for 0.015 s; rows outside `active` (B,) stay."""
        targets = np.zeros((self.num_envs, len(JOINTS)))
        targets[:, COMMANDED] = self.ranges.targets(action.double()).numpy()
        self.bodies.step(targets, None if active is None else active.numpy())
        self.failed = torch.from_numpy(~self.bodies.healthy)
        return Step(
            observation=self._observe(),
            reward=torch.from_numpy(self.bodies.reward).float(),
            terminated=self.failed.clone(),
            success=torch.zeros(self.num_envs, dtype=torch.bool),
        )

    def _observe(self) -> Tensor:
        return self.state[:, 2:]
