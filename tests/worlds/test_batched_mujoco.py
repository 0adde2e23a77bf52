import gymnasium
import gymnasium_robotics
import numpy as np
import pytest

from astra_data.core.arrays import Floats
from astra_data.robots.ant.tasks import ant_model
from astra_data.worlds.batched_mujoco import BatchedPhysics
from astra_data.worlds.plane.mazes import U_MAZE

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
        model,
        3,
        substeps=5,
        measure=lambda data: (data.ctrl[0], data.actuator_force[0], data.qpos[2]),
        num_threads=2,
    )
    qpos, qvel = standing(3)
    qpos[:, 2] = [1.0, 2.0, 3.0]
    physics.set_state(np.arange(3), qpos, qvel)
    assert physics.measured[:, 2].tolist() == [1.0, 2.0, 3.0]
    control = np.zeros((3, 8))
    control[:, 0] = [0.5, -0.25, 1.0]
    physics.step(control, np.array([True, False, True]))
    assert physics.measured[:, 0].tolist() == [0.5, 0.0, 1.0]
    assert physics.measured[:, 1].tolist() == [0.5, 0.0, 1.0]
    np.testing.assert_array_equal(physics.measured[:, 2], physics.qpos[:, 2])
    assert physics.measured[0, 2] != 1.0
    unmeasured = BatchedPhysics(model, 1, substeps=1, num_threads=1)
    assert unmeasured.measured.shape == (1, 0)
