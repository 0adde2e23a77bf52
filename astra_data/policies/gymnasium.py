"""Gymnasium adapters of the batched environments of any task: an `Env` of one robot, a `VectorEnv` of B.

Actions (A,) are ±1 along each axis; `info` says whether the step reached the goal, failed or touched a wall.
"""

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.lazy import without_gradients
from astra_data.core.seeding import derive, fresh_seed
from astra_data.grounding.descent import seeded
from astra_data.grounding.simulator import NO_GROUNDING
from astra_data.policies.learner import lately, penalty_scale
from astra_data.policies.simulator_env import SimulatorEnv
from astra_data.robots.registry import task_named
from astra_data.worlds.protocols import Step, TargetEnv
from astra_data.worlds.user_code import expect

Array = NDArray[Any]


class SeededSimulatorEnv:
    """A simulated environment whose starts, goals and noise come from a seed of its own."""

    def __init__(self, env: SimulatorEnv) -> None:
        """Wrap `env`, which draws from torch's global generator."""
        self.env = env
        self.num_envs = env.num_envs
        self.observation_size, self.action_size = env.observation_size, env.action_size
        self.reseed(fresh_seed())

    @property
    def failed(self) -> Tensor:
        """Which rows failed in the last step, (B,) bool."""
        return self.env.failed

    @property
    def wall_contact(self) -> Tensor:
        """Which rows the walls stopped in the last step, (B,) bool."""
        return self.env.simulator.blocked

    def reseed(self, seed: int) -> None:
        """Draw later starts, goals and noise from `seed`."""
        self._rng = np.random.default_rng(seed)
        self._noise = torch.Generator().manual_seed(seed).get_state()

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Reset the rows in `mask` (B,), by default all; return observations (B, O)."""
        with seeded(int(self._rng.integers(2**62)), torch.device("cpu")):
            return self.env.reset(mask)

    @without_gradients
    def step(self, action: Tensor) -> Step:
        """Apply `action` (B, A), clipped to ±1."""
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(self._noise)
            step = self.env.step(action)
            self._noise = torch.get_rng_state()
        return step


SeededEnv = TargetEnv | SeededSimulatorEnv  # a batched environment with its own randomness


class SingleEnv(gymnasium.Env[Array, Array]):
    """One row of a batched environment."""

    def __init__(self, env: SeededEnv, max_episode_steps: int | None = None) -> None:
        """Wrap `env`, which has one row; its episodes are truncated after `max_episode_steps`, if given."""
        self.env = env
        self.max_episode_steps = max_episode_steps
        self.observation_space, self.action_space = _spaces(env)
        self._age = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start an episode; `options` are not used."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.reseed(seed)
        self._age = 0
        return self.env.reset()[0].numpy(), dict.fromkeys(_FACTS, False)

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Apply an action (A,) for one control step."""
        command = expect("action", torch.tensor(action, dtype=torch.float32), (self.env.action_size,))
        step = self.env.step(command[None])
        self._age += 1
        info = {name: bool(values[0]) for name, values in _facts(self.env, step).items()}
        truncated = self.max_episode_steps is not None and self._age >= self.max_episode_steps
        return step.observation[0].numpy(), float(step.reward[0]), bool(step.terminated[0]), truncated, info


class BatchedVectorEnv(gymnasium.vector.VectorEnv[Array, Array, Array]):
    """All rows of a batched environment; a finished one starts anew in the same step, as in `SyncVectorEnv`."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(self, env: SeededEnv, max_episode_steps: int) -> None:
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
        return self.env.reset().numpy(), _info(dict.fromkeys(_FACTS, nothing), ~nothing)

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Apply actions (B, A) for one control step."""
        shape = (self.num_envs, self.env.action_size)  # any other would move each row by all of it
        step = self.env.step(expect("action", torch.tensor(actions, dtype=torch.float32), shape))
        self._age += 1
        truncated = self._age >= self.max_episode_steps
        done, facts, observation = step.terminated | truncated, _facts(self.env, step), step.observation
        ended = done.numpy()
        infos = _info({name: values & ~ended for name, values in facts.items()}, np.ones_like(ended))
        if ended.any():
            final = np.full(self.num_envs, None, dtype=object)
            for row in np.flatnonzero(ended):
                final[row] = observation[row].numpy()
            final_info = _info({name: values & ended for name, values in facts.items()}, ended)
            infos |= {"final_obs": final, "_final_obs": ended, "final_info": final_info, "_final_info": ended}
            self._age[done] = 0
            observation = self.env.reset(done)
        rewards = step.reward.numpy().astype(np.float64)
        return observation.numpy(), rewards, step.terminated.numpy(), truncated.numpy(), infos


_FACTS = ("success", "failed", "wall_contact")


def _facts(env: SeededEnv, step: Step) -> dict[str, Array]:
    """Return what `info` says of each row, (B,) bool."""
    values = (step.success, env.failed, env.wall_contact)
    return {name: of_rows.numpy().copy() for name, of_rows in zip(_FACTS, values, strict=True)}


def _info(facts: dict[str, Array], known: Array) -> dict[str, Any]:
    return facts | {f"_{name}": known for name in facts}


def _spaces(env: SeededEnv) -> tuple[Box, Box]:
    observation = Box(-np.inf, np.inf, (env.observation_size,), np.float32)
    return observation, Box(-1.0, 1.0, (env.action_size,), np.float32)


def maze(task: str, **options: Any) -> SingleEnv:
    """Build one environment of `task`, `in_target` or abstract; `options` as for `AntMazeEnv`."""
    return SingleEnv(_mazes(task, 1, **options))


def maze_vector(num_envs: int, task: str, max_episode_steps: int, **options: Any) -> BatchedVectorEnv:
    """Build `num_envs` environments as `maze` does."""
    return BatchedVectorEnv(_mazes(task, num_envs, **options), max_episode_steps)


def _mazes(name: str, num_envs: int, *, in_target: bool, **options: Any) -> SeededEnv:
    task = task_named(name)
    if in_target:
        return task.target(num_envs, seed=fresh_seed(), **options)
    return SeededSimulatorEnv(SimulatorEnv(task.objective, NO_GROUNDING.simulator(task, num_envs, **options)))


_POINTS = 50  # of a learning curve


class WatchedEnv(BatchedVectorEnv):
    """The environment that a row is trained in, which keeps the learning curve, `points`, of who learns there."""

    def __init__(self, env: SimulatorEnv, training: Any) -> None:  # noqa: ANN401 - a Training, whose module imports this
        """Show `env` to the learner of a `training`; with the plus settings, penalties grow with success."""
        seeded = SeededSimulatorEnv(env)
        seeded.reseed(derive(training.seed, "own learner"))
        super().__init__(seeded, training.simulated_steps)
        self.points: list[dict[str, Any]] = []
        self._simulated, self._total, self._progress = env, training.config.total_steps, training.progress
        self._is_lasting = training.task.objective.is_lasting
        self._ramps, self._mastered = training.is_plus and not self._is_lasting, training.config.least_success
        self._steps = self._ended = self._succeeded = self._lasted = 0

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Apply actions (B, A) for one control step."""
        self._simulated.penalty_scale = penalty_scale(self.points, self._mastered) if self._ramps else 1.0
        ages = self._age.numpy() + 1
        stepped = super().step(actions)
        infos = stepped[-1]
        self._steps += self.num_envs
        if "final_info" in infos:
            ended = infos["_final_info"]
            self._ended += int(ended.sum())
            self._lasted += int(ages[ended].sum())
            self._succeeded += int(infos["final_info"]["success"].sum())
        if self._steps * _POINTS >= (len(self.points) + 1) * self._total:
            self._note()
        return stepped

    def finish(self) -> None:
        """End the curve with the last step, if it does not yet."""
        if not self.points or self.points[-1]["steps"] != self._steps:
            self._note()

    def _note(self) -> None:
        """Add a point to the curve, of the episodes that ended since the last one."""
        ended, is_lasting = self._ended, self._is_lasting
        point = {
            "steps": self._steps,
            "share": min(1.0, self._steps / self._total),
            "success": None if is_lasting or not ended else self._succeeded / ended,
            "episode_steps": self._lasted / ended if ended else None,
        }
        self.points.append(point)
        self._ended = self._succeeded = self._lasted = 0
        note = lately([point], "episode_steps" if is_lasting else "success")
        self._progress(min(1.0, self._steps / self._total), note)
