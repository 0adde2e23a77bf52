from functools import partial

import mujoco
import numpy as np
import pytest
import torch

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.worlds.simulators import FreeStates, MujocoModel, NumpySimulator


def test_states_are_set_row_by_row_and_those_handed_out_stay() -> None:
    states = FreeStates(torch.zeros(3, 2))
    before = states.state
    states.reset_to(torch.ones(1, 2), torch.tensor([1]))
    assert states.state.tolist() == [[0.0, 0.0], [1.0, 1.0], [0.0, 0.0]]
    given = torch.full((3, 2), 5.0)
    states.reset_to(given)
    given.zero_()
    assert states.state.unique().tolist() == [5.0]
    assert before.unique().tolist() == [0.0]


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


PENDULUM = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.05" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge" gear="2" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@pytest.fixture
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(PENDULUM)


@pytest.mark.parametrize("num_threads", [1, 2])
def test_equals_mujoco_stepped_one_by_one(model: mujoco.MjModel, num_threads: int) -> None:
    rng = np.random.default_rng(0)
    state = torch.from_numpy(rng.normal(size=(7, 2))).float()
    action = torch.from_numpy(rng.uniform(-2, 2, (7, 1))).float()
    simulator = MujocoModel(model, 7, substeps=5, num_threads=num_threads)
    simulator.reset_to(state)
    assert torch.equal(simulator.state, state)
    landed = simulator.step(action)
    for row in range(7):
        data = mujoco.MjData(model)
        data.qpos[0], data.qvel[0] = state[row].tolist()
        data.ctrl[0] = action[row].item()
        mujoco.mj_step(model, data, 5)
        assert landed[row].tolist() == pytest.approx([data.qpos[0], data.qvel[0]], rel=1e-6)
    assert torch.equal(simulator.state, landed)


def test_motors_with_states_of_their_own_are_refused() -> None:
    slow = PENDULUM.replace('<motor joint="hinge"', '<general dyntype="filter" dynprm="0.1" joint="hinge"')
    with pytest.raises(BadInputError, match="1 actuator states"):
        MujocoModel(mujoco.MjModel.from_xml_string(slow), 1, substeps=1)


def test_a_state_that_diverges_does_not_jump_to_the_initial_pose(model: mujoco.MjModel) -> None:
    simulator = MujocoModel(model, 2, substeps=1)
    simulator.reset_to(torch.tensor([[0.5, 2e10], [0.5, 1.0]]))
    wild, calm = simulator.step(torch.zeros(2, 1))
    assert not wild.isfinite().all() or abs(float(wild[1])) > 1e9
    assert calm.isfinite().all() and float(calm[0]) > 0.5
    assert not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET
