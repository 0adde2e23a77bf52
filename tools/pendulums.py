"""Gymnasium's pendulum as learners want their worlds."""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import Tensor

from astra_data.worlds.protocols import Step

ENV = "Pendulum-v1"
HORIZON = 200
EARLY_STEPS = 12 * HORIZON
"""Of each pendulum, to learn from."""


class Pendulums:
    """B pendulums, restarted when the learner says so.

    Actions within ±1 are scaled to the torque's bounds; `hide_velocity` leaves the pendulum's angle alone.
    """

    action_size = 1

    def __init__(self, num_envs: int, *, seed: int, hide_velocity: bool = False) -> None:
        """Build `num_envs` pendulums."""
        self.num_envs = num_envs
        make = partial(gymnasium.make, ENV, max_episode_steps=-1)
        self._envs = SyncVectorEnv([make] * num_envs, autoreset_mode=AutoresetMode.DISABLED)
        self._envs.reset(seed=seed)
        space = self._envs.single_action_space
        assert isinstance(space, gymnasium.spaces.Box)
        self._limit = float(space.high[0])
        self._shown = 2 if hide_velocity else 3
        self.observation_size = self._shown

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Start the rows in `mask` (B,) anew, by default all."""
        rows = np.ones(self.num_envs, dtype=bool) if mask is None else mask.numpy()
        return self._observation(self._envs.reset(options={"reset_mask": rows})[0])

    def step(self, action: Tensor) -> Step:
        """Apply `action` (B, 1)."""
        torque = self._limit * action.clamp(-1.0, 1.0).numpy()
        observation, reward, terminated, _, _ = self._envs.step(torque)
        ended = torch.from_numpy(terminated.copy())
        return Step(self._observation(observation), torch.from_numpy(reward).float(), ended, ended)

    def _observation(self, values: Any) -> Tensor:  # noqa: ANN401
        return torch.tensor(values[:, : self._shown], dtype=torch.float32)


class Recorder(Pendulums):
    """Keeps all transitions, the pendulums' one after another."""

    def __init__(self, num_envs: int, *, seed: int) -> None:
        """Build `num_envs` pendulums."""
        super().__init__(num_envs, seed=seed)
        self._columns: dict[str, list[Tensor]] = {}

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Start the rows in `mask` (B,) anew, by default all."""
        self._seen = super().reset(mask)
        return self._seen

    def step(self, action: Tensor) -> Step:
        """Apply `action` (B, 1)."""
        step = super().step(action)
        row = {
            "observation": self._seen,
            "action": action.clamp(-1.0, 1.0),
            "reward": step.reward,
            "next_observation": step.observation,
        }
        for name, values in row.items():
            self._columns.setdefault(name, []).append(values)
        self._seen = step.observation
        return step

    def early_episodes(self) -> dict[str, Tensor]:
        """Return all columns (E, T, ...) of the early episodes; later ones are all alike."""
        early = {name: torch.stack(values[:EARLY_STEPS], dim=1) for name, values in self._columns.items()}
        return {name: values.reshape(-1, HORIZON, *values.shape[2:]) for name, values in early.items()}
