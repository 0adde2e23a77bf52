from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from astra_data.core.arrays import Floats
from astra_data.worlds.simulators import NumpySimulator


def turn(state: Floats, command: Floats) -> Floats:
    """Points [x, y] that are turned about the origin by the commanded angle."""
    cos, sin = np.cos(command[:, 0]), np.sin(command[:, 0])
    return np.stack([cos * state[:, 0] - sin * state[:, 1], sin * state[:, 0] + cos * state[:, 1]], axis=-1)


def test_equals_the_function_by_hand() -> None:
    simulator = partial(NumpySimulator, function=turn, size=2, parameters={"timestep_s": 0.1})(3)
    assert simulator.state.tolist() == [[0.0, 0.0]] * 3 and simulator.parameters == {"timestep_s": 0.1}
    rng = np.random.default_rng(0)
    points, angles = rng.normal(size=(3, 2)), rng.normal(size=(2, 3, 1))
    simulator.reset_to(torch.from_numpy(points).float())
    for angle in angles:
        landed = simulator.step(torch.from_numpy(angle).float())
    z = (points[:, 0] + 1j * points[:, 1]) * np.exp(1j * angles.sum(axis=0)[:, 0])
    assert landed.dtype == torch.float32 and torch.equal(landed, simulator.state)
    np.testing.assert_allclose(landed.numpy(), np.column_stack([z.real, z.imag]), atol=1e-6)


def test_the_function_may_change_its_arguments() -> None:
    """States that were handed out stay as they were, and so do the caller's commands."""

    def push(state: Floats, command: Floats) -> Floats:
        command *= 2.0
        state += command
        return state

    simulator, command = NumpySimulator(1, function=push, size=1), torch.ones(1, 1)
    before, first = simulator.state, simulator.step(command)
    second = simulator.step(command)
    assert [float(state) for state in (before, first, second, command)] == [0.0, 2.0, 4.0, 1.0]


def test_the_function_may_return_the_same_array_again() -> None:
    kept, given = np.zeros((1, 1), np.float32), {"timestep_s": 0.1}

    def push(state: Floats, command: Floats) -> NDArray[np.float32]:
        kept[:] = state + command
        return kept

    simulator = NumpySimulator(1, function=push, size=1, parameters=given)
    first, second = simulator.step(torch.ones(1, 1)), simulator.step(torch.ones(1, 1))
    given["timestep_s"] = 9.0
    assert [float(state) for state in (first, second)] == [1.0, 2.0]
    assert simulator.parameters == {"timestep_s": 0.1}
