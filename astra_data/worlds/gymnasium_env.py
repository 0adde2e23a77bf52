"""Environments of Gymnasium as a task's robot or abstract simulator."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import gymnasium
from astra_data.worlds.commands import Commands
from astra_data.worlds.simulators import NumpySimulator, shaped
from astra_data.worlds.task import State
from astra_data.worlds.user_code import answered, explained

type Env = gymnasium.Env[Any, Any]
_SLACK = 1e-5  # share of the range of an action by which rounding may carry it beyond
_ADVICE = "give GymnasiumRobot a command, a function of a command and a state that returns an action"


def observed(env: Env, observation: Any) -> State:  # noqa: ANN401 - whatever the environment shows
    """Return the observation as the robot's state; of a `GoalEnv` its entry "observation"."""
    if isinstance(observation, dict) and "observation" not in observation:
        wanted = "a read_state, a function of the environment and what it shows that returns the state (S,)"
        raise BadInputError(f"the environment shows {', '.join(observation)}: give GymnasiumRobot {wanted}")
    shown = observation["observation"] if isinstance(observation, dict) else observation
    return np.asarray(shown, dtype=np.float64)


def as_given(command: Floats, state: State) -> Floats:
    """Return the command as the environment's action."""
    return command


def made(env_id: str | Callable[..., Env], **options: Any) -> Env:
    """Return the environment `env_id`, or of that class, with its `options`."""
    if callable(env_id):
        return answered(f"making {_name(env_id)}", partial(env_id, **options))
    with explained(f"gymnasium.make({env_id!r})"):
        # The horizon is the task's, and what is wrong with states is told by the task.
        env: Env = gymnasium.make(env_id, max_episode_steps=-1, disable_env_checker=True, **options)
        return env


def _name(env_id: str | Callable[..., Env]) -> str:
    return env_id if isinstance(env_id, str) else getattr(env_id, "__name__", repr(env_id))


class GymnasiumRobot:
    """One environment of Gymnasium as a robot: its rewards, goals and time limit are left out.

    `partial(GymnasiumRobot, "gymnasium_robotics:FetchReach-v4")` is the `robot` of a task.

    Example:
        >>> from astra_data.worlds.gymnasium_env import GymnasiumRobot
        >>> robot = GymnasiumRobot("Pendulum-v1", command=lambda command, state: 2.0 * command)
        >>> robot.reset(seed=0).shape
        (3,)
    """

    def __init__(
        self,
        env_id: str | Callable[..., Env],
        *,
        read_state: Callable[[Env, Any], State] = observed,
        command: Callable[[Floats, State], Any] = as_given,
        failed: Callable[[State, bool], bool] | None = None,
        **options: Any,
    ) -> None:
        """Make the environment.

        env_id: as `gymnasium.make` takes it, "module:Env-v0", a class, or a function that makes it. read_state: the
        state (S,) of the environment and an observation. command: the action of a command (A,) and the state. failed:
        whether the robot failed, of a state and whether the environment terminated; by default whether it did.
        """
        self.name, self.env = _name(env_id), made(env_id, **options)
        self._read_state, self._command, self._failed = read_state, command, failed
        self.any_end_fails = failed is None
        if isinstance(space := self.env.action_space, gymnasium.spaces.Box):
            slack = np.nan_to_num(_SLACK * (space.high - space.low), posinf=0.0)
            self._least, self._largest = space.low - slack, space.high + slack

    def reset(self, seed: int | None = None) -> State:
        """Start an episode of the environment, at random by `seed`; return the state (S,)."""
        observation, _ = self.env.reset(seed=seed)
        self._state = self._read_state(self.env.unwrapped, observation)
        return self._state

    def step(self, command: Floats) -> tuple[State, bool]:
        """Apply `command` (A,), in its units; return the state (S,) one period later, and if it failed."""
        observation, _, terminated, _, _ = self.env.step(self._action(command))
        self._state = self._read_state(self.env.unwrapped, observation)
        return self._state, bool(self._failed(self._state, terminated) if self._failed else terminated)

    def check_commands(self, limits: Commands) -> None:
        """Reset; refuse (BadInputError) least or largest commands that make no action of the environment."""
        self.reset(seed=0)
        for command in np.array([*limits.values()]).T:
            self._action(command)

    def _action(self, command: Floats) -> Any:  # noqa: ANN401 - whatever the environment takes
        action, space = self._command(command, self._state), self.env.action_space
        if not isinstance(space, gymnasium.spaces.Box):
            return action
        if np.shape(action) != space.shape:
            raise BadInputError(f"{self.name} takes actions of shape {space.shape}, got {np.shape(action)}: {_ADVICE}")
        if self._command is as_given:
            beyond = np.flatnonzero((action < self._least) | (action > self._largest))
            if len(beyond):
                low, high, given = (float(np.ravel(of)[beyond[0]]) for of in (space.low, space.high, action))
                taken = f"actions of {low:g} to {high:g} in entry {beyond[0]}"
                found = f"the command is {given:g}: narrow the task's commands, or {_ADVICE}"
                raise BadInputError(f"{self.name} takes {taken}, and {found}")
        return action


_TOLERANCE = 1e-4  # of a state that was written and read again: states are float32


class GymnasiumSimulator(NumpySimulator):
    """B abstract states that one environment of Gymnasium steps, one by one: for pairing, or where it is quick."""

    def __init__(
        self,
        num_envs: int,
        *,
        env_id: str,
        size: int,
        read: Callable[[Env], State],
        write: Callable[[Env, State], object],
        parameters: Mapping[str, float] | None = None,
        **options: Any,
    ) -> None:
        """Make the environment, and begin with B states of zeros, each of `size`.

        read: returns the abstract state (X,) of the unwrapped environment. write: sets it, so that `read` returns it.
        """
        env = made(env_id, **options)
        inner, is_checked = env.unwrapped, False
        env.reset(seed=0)

        def shown(inner: Env) -> Floats:
            return shaped(f"{env_id}: read(env)", read(inner), (size,), f"return {size} values, or give another size")

        def step_each(states: Floats, commands: Floats) -> Floats:
            nonlocal is_checked
            if env.action_space.shape != commands.shape[1:]:
                expected = f"expected as many commands as actions, {env.action_space}"
                raise BadInputError(f"{env_id}: {expected}: got {commands.shape[1]}")
            landed = np.empty_like(states)
            for row, (state, command) in enumerate(zip(states, commands, strict=True)):
                write(inner, state)
                env.step(command)
                landed[row] = shown(inner)
                if not is_checked:
                    env.reset(seed=0)
                    write(inner, written := landed[row])
                    if not np.allclose(found := shown(inner), written, rtol=_TOLERANCE, atol=_TOLERANCE):
                        raise BadInputError(
                            f"{env_id}: after write(env, {written.tolist()}) expected the same of read(env), "
                            f"got {found.tolist()}: write has to set what read returns"
                        )
                    is_checked = True
            return landed

        super().__init__(num_envs, function=step_each, size=size, parameters=parameters)
