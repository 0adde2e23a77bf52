"""Gymnasium adapters of the batched environments: an `Env` of one robot and a `VectorEnv` of B.

Observations are (31,) in the target (state, goal) and (8,) in the abstract simulator (see
`simulator_env.policy_observation`); actions are velocity commands (2,) in [-1, 1] m/s. `info` has whether the
step reached the goal ("success") and whether it touched a wall ("wall_contact").
"""

from typing import Any, Protocol

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from astra_data.grounding.raw import NO_GROUNDING
from astra_data.grounding.simulator import EpisodeSimulator
from astra_data.training.simulator_env import SimulatorEnv
from astra_data.worlds.batched import BatchedEnv, Step
from astra_data.worlds.objective import Objective
from astra_data.worlds.registry import task_named

Array = NDArray[Any]


class SeededEnv(BatchedEnv, Protocol):
    """A batched environment with its own randomness."""

    @property
    def wall_contact(self) -> Tensor:
        """Which rows touched a wall in the last step, (B,) bool."""
        ...

    def reseed(self, seed: int) -> None:
        """Draw all later randomness from `seed`."""
        ...


class SeededSimulatorEnv(SimulatorEnv):
    """The task in an abstract simulator, with starts and goals from a seed of its own."""

    def __init__(self, objective: Objective, simulator: EpisodeSimulator) -> None:
        """Set the task in `simulator`."""
        super().__init__(objective, simulator)
        self.reseed(_fresh_seed())

    @property
    def wall_contact(self) -> Tensor:
        """Which rows the walls stopped in the last step, (B,) bool."""
        return self.simulator.blocked

    def reseed(self, seed: int) -> None:
        """Draw later starts and goals from `seed`."""
        self._rng = np.random.default_rng(seed)

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Reset the rows in `mask` (B,), by default all; return observations (B, 8)."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(self._rng.integers(2**62)))
            return super().reset(mask)


class SingleEnv(gymnasium.Env[Array, Array]):
    """One row of a batched environment. There is no time limit here: `gymnasium.make` adds it."""

    def __init__(self, env: SeededEnv) -> None:
        """Wrap `env`, which has one row."""
        self.env = env
        self.observation_space, self.action_space = _spaces(env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode; `options` are not used."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.reseed(seed)
        return self.env.reset()[0].numpy(), {"success": False, "wall_contact": False}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Apply a command (2,) for one control step."""
        step = self.env.step(torch.tensor(action, dtype=torch.float32)[None])
        info = {"success": bool(step.success[0]), "wall_contact": bool(self.env.wall_contact[0])}
        return step.observation[0].numpy(), float(step.reward[0]), bool(step.terminated[0]), False, info


class BatchedVectorEnv(gymnasium.vector.VectorEnv[Array, Array, Array]):
    """All rows of a batched environment; a finished one starts anew in the same step.

    Its last observation and info are in the infos "final_obs" and "final_info", as in `SyncVectorEnv`.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(self, env: SeededEnv, max_episode_steps: int) -> None:
        """Wrap `env`; its episodes are truncated after `max_episode_steps`."""
        self.env = env
        self.num_envs = env.num_envs
        self.max_episode_steps = max_episode_steps
        self.single_observation_space, self.single_action_space = _spaces(env)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._age = torch.zeros(self.num_envs, dtype=torch.long)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start all episodes from one seed (of a list, the first); `options` are not used."""
        first = seed[0] if isinstance(seed, list) else seed
        super().reset(seed=first)
        if first is not None:
            self.env.reseed(first)
        self._age.zero_()
        nothing = np.zeros(self.num_envs, dtype=bool)
        everyone = np.ones(self.num_envs, dtype=bool)
        return self.env.reset().numpy(), _info(nothing, nothing, everyone)

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Apply commands (B, 2) for one control step."""
        step = self.env.step(torch.tensor(actions, dtype=torch.float32))
        self._age += 1
        truncated = self._age >= self.max_episode_steps
        observation, infos = self._restart(step, step.terminated | truncated)
        rewards = step.reward.numpy().astype(np.float64)
        return observation, rewards, step.terminated.numpy(), truncated.numpy(), infos

    def _restart(self, step: Step, done: Tensor) -> tuple[Array, dict[str, Any]]:
        success, contact, ended = step.success.numpy(), self.env.wall_contact.numpy().copy(), done.numpy()
        infos = _info(success & ~ended, contact & ~ended, np.ones_like(ended))
        if not ended.any():
            return step.observation.numpy(), infos
        final = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(ended):
            final[row] = step.observation[row].numpy()
        infos |= {"final_obs": final, "_final_obs": ended}
        infos |= {"final_info": _info(success & ended, contact & ended, ended), "_final_info": ended}
        self._age[done] = 0
        return self.env.reset(done).numpy(), infos


def _info(success: Array, wall_contact: Array, known: Array) -> dict[str, Any]:
    return {"success": success, "_success": known, "wall_contact": wall_contact, "_wall_contact": known}


def _spaces(env: SeededEnv) -> tuple[Box, Box]:
    observation = Box(-np.inf, np.inf, (env.observation_size,), np.float32)
    return observation, Box(-1.0, 1.0, (env.action_size,), np.float32)


def _fresh_seed() -> int:
    return int(np.random.default_rng().integers(2**62))


def ant_maze(task: str, **options: Any) -> SingleEnv:  # noqa: ANN401 - handed on
    """Build one target environment of `task`; `options` as for `AntMazeEnv`."""
    return SingleEnv(task_named(task).target(1, seed=_fresh_seed(), **options))


def ant_maze_vector(
    num_envs: int,
    task: str,
    max_episode_steps: int,
    **options: Any,  # noqa: ANN401 - handed on
) -> BatchedVectorEnv:
    """Build `num_envs` target environments of `task`; `options` as for `AntMazeEnv`."""
    env = task_named(task).target(num_envs, seed=_fresh_seed(), **options)
    return BatchedVectorEnv(env, max_episode_steps)


def point_maze(task: str) -> SingleEnv:
    """Build one abstract environment of `task`."""
    found = task_named(task)
    return SingleEnv(SeededSimulatorEnv(found.objective, NO_GROUNDING.simulator(found, 1)))


def point_maze_vector(num_envs: int, task: str, max_episode_steps: int) -> BatchedVectorEnv:
    """Build `num_envs` abstract environments of `task`."""
    found = task_named(task)
    simulator = NO_GROUNDING.simulator(found, num_envs)
    return BatchedVectorEnv(SeededSimulatorEnv(found.objective, simulator), max_episode_steps)
