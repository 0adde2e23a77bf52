"""The ant on an open plane, following velocity commands: the environment that trains its controller."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Floats
from astra_data.robots.ant.body import (
    CONTROL_SUBSTEPS,
    TIMESTEP_S,
    TOPPLE_COSINE,
    ant_model,
    canonical_view,
    standing_pose,
    torques_to_body,
    up_cosine,
)
from astra_data.worlds.batched_mujoco import BatchedPhysics
from astra_data.worlds.geometry import rotation_matrix
from astra_data.worlds.protocols import Step


@dataclass(frozen=True)
class AntVelocityConfig:
    """Distribution of commands, strength of the motors, and rewards.

    At full torque the ant moves so violently that SAC learns to stand still; at 0.7 of it, it learns to walk.
    A higher reward for staying upright also makes it stand still.
    """

    num_envs: int = 64
    num_threads: int | None = None
    """Physics threads, by default one per core."""
    torque_scale: float = 0.7
    """Largest torque as a share of the motors' limit."""
    upright_reward: float = 0.5
    torque_weight: float = 0.02
    zero_command_share: float = 0.15
    hold_s: tuple[float, float] = (1.0, 3.0)
    fall_reward: float = -3.0


class AntVelocityEnv:
    """B ants under joint torques, rewarded for the commanded planar velocity.

    Observation (B, 28) and action (B, 8) are in the canonical heading frame of `worlds.ant.body`. Commands
    are drawn from U[-1, 1]² m/s, a share of them zero, and held for 1 to 3 s. A fall ends the episode.
    """

    observation_size = 28
    action_size = 8

    def __init__(self, config: AntVelocityConfig, *, seed: int) -> None:
        self.config = config
        self.num_envs = config.num_envs
        model = ant_model()
        self.physics = BatchedPhysics(
            model, config.num_envs, substeps=CONTROL_SUBSTEPS, num_threads=config.num_threads
        )
        self.command: Floats = np.zeros((config.num_envs, 2))
        self.steps_since_change = np.zeros(config.num_envs, dtype=int)
        self._hold = np.zeros(config.num_envs, dtype=int)
        self._rng = np.random.default_rng(seed)
        self._quarters: NDArray[np.intp] = np.zeros(config.num_envs, dtype=np.intp)

    def reset(self, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Set the ants in `mask` (B,), by default all, upright at random headings; return (B, 28)."""
        rows = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask.numpy())
        count = len(rows)
        qpos = standing_pose(count)
        qpos[:, 7:] += self._rng.uniform(-0.1, 0.1, (count, 8))
        yaw = self._rng.uniform(-np.pi, np.pi, count)
        qpos[:, 3], qpos[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
        self.physics.set_state(rows, qpos, self._rng.normal(0.0, 0.1, (count, 14)))
        self._draw_commands(rows)
        return self._observe()

    def step(self, action: torch.Tensor) -> Step:
        """Apply torques `action` (B, 8) in [-1, 1] for one control step."""
        torques = self.config.torque_scale * action.numpy().astype(np.float64)
        self.physics.step(torques_to_body(torques, self._quarters))
        fallen = self.fallen()
        reward = self._reward(torques, fallen)
        self.draw_due_commands()
        return Step(
            observation=self._observe(),
            reward=torch.from_numpy(reward).float(),
            terminated=torch.from_numpy(fallen),
            success=torch.zeros(self.num_envs, dtype=torch.bool),
        )

    def fallen(self) -> Bools:
        """Return which ants (B,) have toppled or left plausible heights."""
        height = self.physics.qpos[:, 2]
        toppled = up_cosine(self.physics.qpos[:, 3:7]) < TOPPLE_COSINE
        return np.asarray(toppled | (height < 0.2) | (height > 1.5))

    def tracking_error(self) -> Floats:
        """Return the distance in m/s (B,) between commanded and present planar velocity."""
        return np.asarray(np.linalg.norm(self.physics.qvel[:, :2] - self.command, axis=1))

    def draw_due_commands(self) -> None:
        """Count one step, and draw new commands where the old ones have been held long enough."""
        self.steps_since_change += 1
        self._draw_commands(np.flatnonzero(self.steps_since_change >= self._hold))

    def _draw_commands(self, rows: NDArray[np.intp]) -> None:
        low, high = (round(seconds / TIMESTEP_S) for seconds in self.config.hold_s)
        drawn = self._rng.uniform(-1.0, 1.0, (len(rows), 2))
        drawn[self._rng.random(len(rows)) < self.config.zero_command_share] = 0.0
        self.command[rows] = drawn
        self._hold[rows] = self._rng.integers(low, high + 1, len(rows))
        self.steps_since_change[rows] = 0

    def _reward(self, torques: Floats, fallen: Bools) -> Floats:
        qpos, qvel = self.physics.qpos, self.physics.qvel
        error = self.tracking_error()
        yaw_rate = np.einsum("bj,bj->b", rotation_matrix(qpos[:, 3:7])[:, 2], qvel[:, 3:6])
        reward = 0.7 * np.exp(-(error**2) / 0.1) - error + self.config.upright_reward
        reward -= self.config.torque_weight * (torques**2).sum(axis=1) + 0.3 * (1.0 - up_cosine(qpos[:, 3:7]))
        reward -= 0.05 * yaw_rate**2 + 0.05 * qvel[:, 2] ** 2
        standing = ~self.command.any(axis=1)
        reward -= 0.05 * standing * (qvel[:, 6:] ** 2).mean(axis=1)
        return np.where(fallen, self.config.fall_reward, reward)

    def _observe(self) -> torch.Tensor:
        observation, self._quarters = canonical_view(self.physics.qpos, self.physics.qvel, self.command)
        return torch.from_numpy(observation).float()
