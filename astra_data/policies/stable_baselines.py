"""Vector environments as Stable-Baselines3 wants them, which has an interface of its own."""

from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from stable_baselines3.common.vec_env import VecEnv

from astra_data.policies.gymnasium import Array


class StableBaselinesEnv(VecEnv):
    """A vector environment of Gymnasium as one of Stable-Baselines3.

    Example:
        >>> import gymnasium
        >>> from stable_baselines3 import PPO
        >>> import astra_data.envs
        >>> from astra_data.policies.stable_baselines import StableBaselinesEnv
        >>> robots = gymnasium.make_vec("astra_data/PointMazeUMaze-v0", num_envs=8)
        >>> model = PPO("MlpPolicy", StableBaselinesEnv(robots), n_steps=16, batch_size=128)
    """

    def __init__(self, env: VectorEnv[Array, Array, Array]) -> None:
        self.env = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Array:
        """Start all rows, from the seed that was set last if there is one; return observations (B, O)."""
        observation, _ = self.env.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observation

    def step_async(self, actions: Array) -> None:
        """Keep `actions` (B, A) for `step_wait`."""
        self.actions = actions

    def step_wait(self) -> tuple[Array, Array, Array, list[dict[str, Any]]]:
        """Step all rows; a finished one starts anew."""
        observation, reward, terminated, truncated, infos = self.env.step(self.actions)
        done = terminated | truncated
        facts: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(done):
            facts[row] = {
                "terminal_observation": infos["final_obs"][row],
                "TimeLimit.truncated": bool(truncated[row] and not terminated[row]),
            }
        return observation, reward, done, facts

    def close(self) -> None:
        """Do nothing."""

    def get_attr(self, attr_name: str, indices: object = None) -> list[object]:
        """Know of no attributes."""
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: object, indices: object = None) -> None:
        """Refuse."""
        raise NotImplementedError("rows of one batch have no attributes of their own")

    def env_method(self, method_name: str, *args: object, indices: object = None, **kwargs: object) -> list[Any]:
        """Refuse."""
        raise NotImplementedError("rows of one batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type, indices: object = None) -> list[bool]:
        """Know of no wrappers."""
        return [False] * self.num_envs
