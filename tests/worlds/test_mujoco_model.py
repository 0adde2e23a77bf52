import mujoco
import numpy as np
import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.worlds.simulators import MujocoModel

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


def test_some_rows_are_reset_and_earlier_states_stay(model: mujoco.MjModel) -> None:
    simulator = MujocoModel(model, 3, substeps=1)
    before = simulator.state
    simulator.reset_to(torch.tensor([[1.0, 2.0]]), torch.tensor([1]))
    assert simulator.state.tolist() == [[0, 0], [1, 2], [0, 0]]
    assert before.tolist() == [[0, 0]] * 3


def test_parameters_name_the_step(model: mujoco.MjModel) -> None:
    assert MujocoModel(model, 1, substeps=4).parameters == {"timestep_s": 0.04, "substeps": 4}


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
