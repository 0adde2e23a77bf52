from functools import partial

import gymnasium
import numpy as np
import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.worlds.gymnasium_env import Env, GymnasiumSimulator
from astra_data.worlds.robot import State


def read(env: Env) -> State:
    state: State = env.state  # type: ignore[attr-defined]
    return state


def write(env: Env, state: State) -> None:
    env.state = state  # type: ignore[attr-defined]


make = partial(GymnasiumSimulator, size=2, read=read, write=write)


def test_every_state_is_stepped_as_by_an_environment_of_its_own() -> None:
    simulator = make(3, env_id="Pendulum-v1", parameters={"gravity": 10.0})
    assert simulator.state.tolist() == [[0.0, 0.0]] * 3 and simulator.parameters == {"gravity": 10.0}
    rng = np.random.default_rng(0)
    states, commands = rng.normal(size=(3, 2)), rng.uniform(-2, 2, (250, 3, 1)).astype(np.float32)
    simulator.reset_to(torch.from_numpy(states).float())
    for command in commands:  # longer than the environment's own episodes
        landed = simulator.step(torch.from_numpy(command))
    for number, state in enumerate(states):
        env = gymnasium.make("Pendulum-v1").unwrapped
        env.reset(seed=number)
        write(env, state)
        for command in commands:
            env.step(command[number])
            write(env, np.asarray(read(env), np.float32))  # as the simulator keeps it
        np.testing.assert_allclose(landed[number].numpy(), read(env), rtol=1e-3)


def test_options_are_those_of_the_environment() -> None:
    heavy, light = (make(1, env_id="Pendulum-v1", g=gravity) for gravity in (10.0, 1.0))
    for simulator in (heavy, light):
        simulator.reset_to(torch.tensor([[0.5, 0.0]]))
    assert heavy.step(torch.zeros(1, 1))[0, 1] > 5 * light.step(torch.zeros(1, 1))[0, 1] > 0


def test_an_environment_that_is_not_there_is_told() -> None:
    with pytest.raises(BadInputError, match=r"gymnasium\.make\('Nowhere-v0'\)"):
        make(1, env_id="Nowhere-v0")


def test_what_is_written_has_to_be_what_is_read() -> None:
    """Entries in another order, say; after the first step nothing is read twice."""

    def swapped(env: Env, state: State) -> None:
        write(env, state[::-1])

    def nothing(env: Env, state: State) -> None:
        pass

    for wrong in (swapped, nothing):
        simulator = GymnasiumSimulator(2, env_id="Pendulum-v1", size=2, read=read, write=wrong)
        simulator.reset_to(torch.tensor([[0.5, 0.5], [1.0, 0.25]]))
        with pytest.raises(BadInputError, match=r"^Pendulum-v1: after write\(.* expected the same"):
            simulator.step(torch.zeros(2, 1))
    reads = []

    def noted(env: Env) -> State:
        reads.append(0)
        return read(env)

    simulator = GymnasiumSimulator(2, env_id="Pendulum-v1", size=2, read=noted, write=write)
    for expected in (3, 5):
        simulator.step(torch.zeros(2, 1))
        assert len(reads) == expected


def test_a_state_that_the_environment_never_shows_may_be_set() -> None:
    """As a correction of it may be, with cosine and sine of no angle."""

    def shown(env: Env) -> State:
        angle, rate = read(env)
        return [np.cos(angle), np.sin(angle), rate]

    def turned(env: Env, state: State) -> None:
        write(env, np.array([np.arctan2(state[1], state[0]), state[2]]))

    simulator = GymnasiumSimulator(1, env_id="Pendulum-v1", size=3, read=shown, write=turned)
    simulator.reset_to(torch.tensor([[1.5, -0.5, 0.1]]))
    landed = simulator.step(torch.zeros(1, 1))
    assert float(landed[0, :2].norm()) == pytest.approx(1.0)
