"""The target of a task, as an environment of LeRobot."""

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Space
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.processor import PolicyProcessorPipeline, RenameObservationsProcessorStep
from lerobot.utils.constants import OBS_STR
from numpy.typing import NDArray

from astra_data.core.errors import BadInputError
from astra_data.core.seeding import fresh_seed
from astra_data.dataset.columns import ACTION, GOAL, STATE
from astra_data.deployment.folder import TYPE
from astra_data.robots.registry import task_named
from astra_data.worlds.task import Task

Array = NDArray[Any]


@EnvConfig.register_subclass(TYPE)
@dataclass
class AstraDataEnv(EnvConfig):  # type: ignore[misc]
    """The target of `task`, a name or a place such as cart.py:TASK, whose code is run; names are datasets' columns."""

    def __post_init__(self) -> None:
        """Take rate and sizes from the task; raise a BadInputError if none is named, or it is not known."""
        if self.task is None:
            raise BadInputError("--env.task: expected a task, such as antmaze-umaze or cart.py:TASK")
        task = task_named(self.task)
        sizes = {
            STATE: (FeatureType.STATE, task.state.size),
            GOAL: (FeatureType.ENV, task.objective.goal_size),
            ACTION: (FeatureType.ACTION, task.objective.action_size),
        }
        self.fps = task.fps
        self.features = {name: PolicyFeature(kind, (size,)) for name, (kind, size) in sizes.items() if size}
        self.features_map = {name: name for name in self.features}

    gym_kwargs: ClassVar[dict[str, Any]] = {}  # the environment is made here, not by an id

    def get_env_processors(self) -> tuple[Any, Any]:
        """Return what takes the prefix away again that LeRobot gives to names which are not its own."""
        names = {f"{OBS_STR}.{name}": name for name in (STATE, GOAL)}
        steps = [RenameObservationsProcessorStep(rename_map=names)]
        return PolicyProcessorPipeline(steps=steps), PolicyProcessorPipeline(steps=[])

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv[Any, Any, Any]]]:
        """Build `n_envs` targets, which are stepped one after another in this process."""
        make = freeze_after_episode_end(partial(TargetRobot, task_named(self.task)))
        return {TYPE: {0: SyncVectorEnv([make] * n_envs, autoreset_mode=AutoresetMode.NEXT_STEP)}}


class TargetRobot(gymnasium.Env[dict[str, Any], Array]):
    """One robot of a task's target; commands (A,) are in their units, and clipped to their bounds."""

    def __init__(self, task: Task) -> None:
        """Build the target of `task`, with a seed of its own until `reset` gives one."""
        self._env, self._task = task.target(1, seed=fresh_seed(), num_threads=1), task
        self.task, self.task_description = task.name, task.instruction
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": task.fps}
        self.render_mode = "rgb_array"
        self._max_episode_steps = task.objective.horizon
        self._sizes = {STATE: task.state.size} | ({GOAL: goal} if (goal := task.objective.goal_size) else {})
        boxes: dict[str, Space[Any]] = {name: Box(-np.inf, np.inf, (size,)) for name, size in self._sizes.items()}
        self.observation_space = Dict(boxes)
        self.action_space = Box(*np.array(list(task.limits.values()), np.float32).T)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Start an episode; `options` are not used."""
        super().reset(seed=seed)
        if seed is not None:
            self._env.reseed(seed)
        self._env.reset()
        self._age = 0
        return self._observe(), {"is_success": False}

    def step(self, action: Array) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        """Give the robot a command (A,) for one control period."""
        command = torch.tensor(action, dtype=torch.float32)[None]
        step, objective = self._env.step(self._task.limits.normal(command)), self._task.objective
        self._age += 1
        info = {"is_success": bool(objective.succeeded(step.success, self._env.failed, self._age)[0])}
        is_over = self._age >= objective.horizon
        return self._observe(), float(step.reward[0]), bool(step.terminated[0]), is_over, info

    def render(self) -> Array:
        """Return a blank picture (height, width, 3), as LeRobot films what it evaluates."""
        return np.full((64, 64, 3), 255, np.uint8)

    def _observe(self) -> dict[str, Array]:
        shown = {STATE: self._env.state, GOAL: self._env.goal}
        return {name: shown[name][0].numpy().copy() for name in self._sizes}
