"""An abstract simulator that is an environment of Gymnasium whose state can be set."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.worlds.gymnasium_robot import Env, made
from astra_data.worlds.numpy_simulator import NumpySimulator
from astra_data.worlds.robot import State

_TOLERANCE = 1e-4
"""Of a state that was written and read again: states are float32."""


class GymnasiumSimulator(NumpySimulator):
    """B abstract states that one environment of Gymnasium steps, one after another.

    A policy is trained in millions of steps, so it is for environments that step quickly, and for pairing.

    Example:
        >>> from functools import partial
        >>> import torch
        >>> from astra_data.worlds.gymnasium_simulator import GymnasiumSimulator
        >>> def read(env):
        ...     return env.state
        >>> def write(env, state):
        ...     env.state = state
        >>> make_simulator = partial(GymnasiumSimulator, env_id="Pendulum-v1", size=2, read=read, write=write)
        >>> make_simulator(3).step(torch.ones(3, 1)).shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        num_envs: int,
        *,
        env_id: str,
        size: int,
        read: Callable[[Env], State],
        write: Callable[[Env, State], object],
        parameters: Mapping[str, float] | None = None,
        **options: Any,  # noqa: ANN401 - handed on
    ) -> None:
        """Make the environment, and begin with B states of zeros.

        Args:
            num_envs: B.
            env_id: as `gymnasium.make` takes it, with the module that registers it: "module:Env-v0".
            size: of a state, X.
            read: returns the abstract state (X,) of the environment, without its wrappers.
            write: sets it, so that `read` returns it again; this is tried after the first step. All that a
                step depends on has to be in it.
            parameters: numbers or texts about it, by default none.
            options: of the environment.

        Raises:
            BadInputError: the environment cannot be made.
        """
        env = made(env_id, **options)
        env.reset(seed=0)
        is_checked = False

        def step_each(states: Floats, commands: Floats) -> Floats:
            nonlocal is_checked
            landed = np.empty_like(states)
            for row, (state, command) in enumerate(zip(states, commands, strict=True)):
                write(env, state)
                env.step(command)
                landed[row] = read(env)
                if not is_checked:
                    env.reset(seed=0)
                    write(env, landed[row])
                    _check_written(env_id, landed[row], np.asarray(read(env)))
                    is_checked = True
            return landed

        super().__init__(num_envs, function=step_each, size=size, parameters=parameters)


def _check_written(env_id: str, state: Floats, shown: Floats) -> None:
    if shown.shape != state.shape or not np.allclose(shown, state, rtol=_TOLERANCE, atol=_TOLERANCE):
        raise BadInputError(
            f"{env_id}: after write(env, {state.tolist()}) expected the same of read(env), "
            f"got {shown.tolist()}: write has to set what read returns"
        )
