from functools import partial

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np
import pytest
import torch

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.robots.ant.tasks import ant_model
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.simulators import BatchedPhysics, MujocoModel, NumpySimulator


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


def test_a_function_that_returns_no_state_of_every_row_is_refused() -> None:
    for wrong, got in ((lambda state, command: None, "None"), (lambda state, command: state[1:], r"\(2, 2\)")):
        with pytest.raises(
            BadInputError, match=rf"function of .* expected .* \(3, 2\), got {got}: return the next state"
        ):
            NumpySimulator(3, function=wrong, size=2).step(torch.zeros(3, 1))  # type: ignore[arg-type]


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


def test_what_is_no_model_or_no_number_of_steps_or_motors_is_refused(model: mujoco.MjModel) -> None:
    with pytest.raises(BadInputError, match=r"expected a model, such as .*, got 'robot.xml'"):
        MujocoModel("robot.xml", 1, substeps=1)
    for substeps in (0, 2.5):
        with pytest.raises(BadInputError, match=f"substeps: expected a whole number of 1 or more, got {substeps}"):
            MujocoModel(model, 1, substeps=substeps)  # type: ignore[arg-type]
    with pytest.raises(BadInputError, match="expected as many commands as motors, 1: got 2"):
        MujocoModel(model, 1, substeps=1).step(torch.zeros(1, 2))


def test_a_state_that_diverges_does_not_jump_to_the_initial_pose(model: mujoco.MjModel) -> None:
    simulator = MujocoModel(model, 2, substeps=1)
    simulator.reset_to(torch.tensor([[0.5, 2e10], [0.5, 1.0]]))
    wild, calm = simulator.step(torch.zeros(2, 1))
    assert not wild.isfinite().all() or abs(float(wild[1])) > 1e9
    assert calm.isfinite().all() and float(calm[0]) > 0.5
    assert not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET


gymnasium.register_envs(gymnasium_robotics)


def standing(count: int) -> tuple[Floats, Floats]:
    model = ant_model()
    return np.tile(model.qpos0, (count, 1)), np.zeros((count, model.nv))


@pytest.mark.parametrize("num_threads", [1, 2])
def test_equals_gymnasium_robotics_bit_for_bit(num_threads: int) -> None:
    env = gymnasium.make("AntMaze_UMaze-v5").unwrapped
    env.reset(seed=3)
    data = env.ant_env.data  # type: ignore[attr-defined]
    rng = np.random.default_rng(0)
    physics = BatchedPhysics(ant_model(U_MAZE), 3, substeps=5, num_threads=num_threads)
    qpos, qvel = np.tile(data.qpos, (3, 1)), np.tile(data.qvel, (3, 1))
    physics.set_state(np.arange(3), qpos, qvel)
    for _ in range(40):
        torques = rng.uniform(-1, 1, (3, 8))
        physics.step(torques)
        env.step(torques[1])
        np.testing.assert_array_equal(physics.qpos[1], data.qpos)
        np.testing.assert_array_equal(physics.qvel[1], data.qvel)
    assert np.abs(physics.qpos[0] - physics.qpos[1]).max() > 0.1
    env.close()


def test_inactive_rows_stand_still() -> None:
    physics = BatchedPhysics(ant_model(), 4, substeps=5, num_threads=2)
    physics.set_state(np.arange(4), *standing(4))
    before = physics.qpos.copy()
    active = np.array([True, False, False, True])
    physics.step(np.ones((4, 8)), active)
    assert (np.abs(physics.qpos - before).max(axis=1) > 0).tolist() == active.tolist()
    physics.step(np.ones((4, 8)), np.zeros(4, dtype=bool))


def test_a_reset_forgets_the_past() -> None:
    physics = BatchedPhysics(ant_model(U_MAZE), 2, substeps=5, num_threads=1)
    qpos, qvel = standing(2)
    physics.set_state(np.arange(2), qpos, qvel)
    for _ in range(5):
        physics.step(np.random.default_rng(0).uniform(-1, 1, (2, 8)) * [[1.0], [-1.0]])
    physics.set_state(np.array([0]), qpos[:1], qvel[:1])
    fresh = BatchedPhysics(ant_model(U_MAZE), 1, substeps=5, num_threads=1)
    fresh.set_state(np.arange(1), qpos[:1], qvel[:1])
    np.testing.assert_array_equal(physics.state[0], fresh.state[0])
    for _ in range(5):
        physics.step(np.full((2, 8), 0.3))
        fresh.step(np.full((1, 8), 0.3))
    np.testing.assert_array_equal(physics.qpos[0], fresh.qpos[0])


def test_a_watched_floor_is_felt_by_those_who_touch_it() -> None:
    physics = BatchedPhysics(ant_model(), 2, substeps=1, watched_geoms=(0, 0), num_threads=1)
    qpos, qvel = standing(2)
    qpos[:, 7:] = [0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0]
    qpos[0, 2], qpos[1, 2] = 0.3, 2.0
    physics.set_state(np.arange(2), qpos, qvel)
    physics.step(np.zeros((2, 8)))
    assert physics.touching.tolist() == [True, False]
    physics.set_state(np.arange(2), qpos, qvel)
    assert not physics.touching.any()


def test_what_is_measured_is_of_the_copys_own_last_step() -> None:
    model = ant_model()
    physics = BatchedPhysics(
        model, 3, substeps=5, measure=lambda data: (data.ctrl[0], data.actuator_force[0], data.qpos[2]), num_threads=2
    )
    qpos, qvel = standing(3)
    qpos[:, 2] = [1.0, 2.0, 3.0]
    physics.set_state(np.arange(3), qpos, qvel)
    assert physics.measured[:, 2].tolist() == [1.0, 2.0, 3.0]
    control = np.zeros((3, 8))
    control[:, 0] = [0.5, -0.25, 1.0]
    physics.step(control, np.array([True, False, True]))
    assert physics.measured[:, 0].tolist() == [0.5, 0.0, 1.0] and physics.measured[:, 1].tolist() == [0.5, 0.0, 1.0]
    np.testing.assert_array_equal(physics.measured[:, 2], physics.qpos[:, 2])
    assert physics.measured[0, 2] != 1.0
    unmeasured = BatchedPhysics(model, 1, substeps=1, num_threads=1)
    assert unmeasured.measured.shape == (1, 0)
