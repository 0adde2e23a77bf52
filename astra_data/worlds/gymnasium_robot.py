"""A robot that is an environment of Gymnasium, named by its id."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from astra_data.worlds.own_code import explained
from astra_data.worlds.robot import State

Env = gymnasium.Env[Any, Any]


def observed(env: Env, observation: Any) -> State:  # noqa: ANN401 - whatever the environment shows
    """Return the observation as the robot's state; of a `GoalEnv` its entry "observation"."""
    shown = observation["observation"] if isinstance(observation, dict) else observation
    return np.asarray(shown, dtype=np.float64)


def as_given(command: NDArray[np.float64], state: State) -> NDArray[np.float64]:
    """Return the command as the environment's action."""
    return command


def if_terminated(state: State, terminated: bool) -> bool:
    """Return whether the environment terminated."""
    return terminated


def made(env_id: str, **options: Any) -> Env:  # noqa: ANN401 - handed on
    """Return the environment `env_id` with its `options`, without wrappers.

    Raises:
        BadInputError: it cannot be made.
    """
    with explained(f"gymnasium.make({env_id!r})"):
        # The horizon is the task's, and what is wrong with states is told by the task.
        env: Env = gymnasium.make(env_id, max_episode_steps=-1, disable_env_checker=True, **options)
    return env.unwrapped


class GymnasiumRobot:
    """One environment of Gymnasium as a robot: its rewards, goals and time limit are left out.

    `partial(GymnasiumRobot, "gymnasium_robotics:FetchReach-v4")` is the `robot` of a task; it can be pickled
    where the three functions can.

    Attributes:
        env: the environment.

    Example:
        >>> from astra_data.worlds.gymnasium_robot import GymnasiumRobot
        >>> robot = GymnasiumRobot("Pendulum-v1", command=lambda command, state: 2.0 * command)
        >>> robot.reset(seed=0).shape
        (3,)
    """

    def __init__(
        self,
        env_id: str,
        *,
        read_state: Callable[[Env, Any], State] = observed,
        command: Callable[[NDArray[np.float64], State], Any] = as_given,
        failed: Callable[[State, bool], bool] = if_terminated,
        **options: Any,  # noqa: ANN401 - handed on
    ) -> None:
        """Make the environment.

        Args:
            env_id: as `gymnasium.make` takes it, with the module that registers it: "module:Env-v0".
            read_state: makes the state (S,) of the environment, without its wrappers, and an observation.
            command: makes an action of the environment of a command (A,) and the state that it is given in.
            failed: whether the robot failed, from the state after a step and whether the environment
                terminated; by default the latter.
            options: of the environment.

        Raises:
            BadInputError: the environment cannot be made.
        """
        self.env = made(env_id, **options)
        self._read_state, self._command, self._failed = read_state, command, failed

    def reset(self, seed: int | None = None) -> State:
        """Start an episode of the environment, at random by `seed`; return the state (S,)."""
        observation, _ = self.env.reset(seed=seed)
        self._state = self._read_state(self.env, observation)
        return self._state

    def step(self, command: NDArray[np.float64]) -> tuple[State, bool]:
        """Apply `command` (A,), in its units; return the state (S,) one period later, and if it failed."""
        observation, _, terminated, _, _ = self.env.step(self._command(command, self._state))
        self._state = self._read_state(self.env, observation)
        return self._state, bool(self._failed(self._state, terminated))
