import mujoco
import numpy as np
import pytest

from astra_data.core.arrays import Floats
from astra_data.robots.nao.kinematics import IDENTICAL
from astra_data.robots.nao.robot import BatchedNao
from astra_data.worlds.plane.mazes import U_MAZE

EVERYONE = np.arange(3)


def commands(steps: int, robots: int) -> Floats:
    drawn = np.random.default_rng(1).uniform(-1, 1, (steps, robots, 3))
    return np.asarray(drawn * [0.2, 0.15, 1.0])


def walk(nao: BatchedNao, steps: int) -> Floats:
    for command in commands(steps, nao.num_robots):
        nao.step(command)
    return nao.bodies.state.copy()


def test_the_same_seed_gives_the_same_bytes_on_any_number_of_threads() -> None:
    first = walk(BatchedNao(5, seed=3, num_threads=1), 8)
    assert first.tobytes() == walk(BatchedNao(5, seed=3, num_threads=1), 8).tobytes()
    assert first.tobytes() == walk(BatchedNao(5, seed=3, num_threads=3), 8).tobytes()
    assert first.tobytes() != walk(BatchedNao(5, seed=4, num_threads=1), 8).tobytes()


def test_it_resumes_exactly() -> None:
    nao = BatchedNao(3, seed=0, num_threads=1)
    walk(nao, 7)
    saved = nao.state_dict()
    ended, angles = walk(nao, 6), nao.angles
    other = BatchedNao(3, seed=0, num_threads=1)
    other.reset(EVERYONE, np.ones((3, 3)), np.random.default_rng(9))
    other.load_state_dict(saved)
    assert walk(other, 6).tobytes() == ended.tobytes()
    np.testing.assert_array_equal(other.angles, angles)


@pytest.mark.parametrize(
    "command", [(0.2, 0.0, 0.0), (-0.12, 0.0, 0.0), (0.0, 0.15, 0.0), (0.0, -0.15, 0.0), (0.0, 0.0, 0.8)]
)
def test_it_walks_as_told(command: tuple[float, float, float]) -> None:
    nao = BatchedNao(1, seed=0, spread=IDENTICAL, num_threads=1)
    poses = []
    for _ in range(25):
        nao.step(np.array([command]))
        poses.append(nao.pose[0])
    moved = (np.unwrap(np.array(poses), axis=0)[-1] - np.array(poses)[10]) / (14 * 0.192)
    if command[2]:
        assert moved[2] == pytest.approx(command[2], rel=0.3)
    else:
        np.testing.assert_allclose(moved[:2], command[:2], atol=0.3 * max(np.abs(command)))
    assert not nao.fallen.any()


def turned(*roll_pitch_yaw: float) -> Floats:
    """Return the quaternion of Rz(yaw) Ry(pitch) Rx(roll)."""
    quaternion = np.zeros(4)
    mujoco.mju_euler2Quat(quaternion, np.array(roll_pitch_yaw), "XYZ")
    return quaternion


def test_a_lean_to_the_right_and_one_ahead_are_positive_and_tilts_see_no_heading() -> None:
    nao = BatchedNao(3, seed=0, num_threads=1)
    nao.bodies.qpos[:, 3:7] = [turned(0.1, 0.0, 0.0), turned(0.0, 0.2, 0.0), turned(-0.3, 0.2, 2.5)]
    np.testing.assert_allclose(nao.tilt, [[0.1, 0.0], [0.0, 0.2], [-0.3, 0.2]], atol=1e-12)
    np.testing.assert_allclose(nao.pose[:, 2], [0.0, 0.0, 2.5], atol=1e-12)


def test_walls_are_felt_and_stop_it() -> None:
    # The wall's face is at x = -6; the robot's toes are 0.1 m ahead of it.
    nao = BatchedNao(2, seed=0, maze=U_MAZE, spread=IDENTICAL, num_threads=1)
    nao.reset(np.arange(2), np.array([[-5.7, 4.0, np.pi], [-4.0, 4.0, np.pi]]), np.random.default_rng(0))
    felt = np.zeros(2, dtype=bool)
    for _ in range(15):
        nao.step(np.tile([0.2, 0.0, 0.0], (2, 1)))
        felt |= nao.touching
    assert felt.tolist() == [True, False]
    assert nao.pose[0, 0] > -5.95


def test_a_fallen_robot_is_told_and_stays_until_its_reset() -> None:
    nao = BatchedNao(2, seed=0, num_threads=1)
    half = np.radians(30)
    nao.bodies.qpos[0, 3:7] = [np.cos(half), 0.0, np.sin(half), 0.0]
    nao.step(np.zeros((2, 3)))
    assert nao.fallen.tolist() == [True, False]
    lying = nao.bodies.state[0].copy()
    nao.step(np.full((2, 3), 0.1))
    np.testing.assert_array_equal(nao.bodies.state[0], lying)
    nao.reset(np.array([0]), np.zeros((1, 3)), np.random.default_rng(0))
    assert not nao.fallen.any()


def test_a_kick_sends_the_ball_ahead() -> None:
    speeds = {}
    for kick in (True, False):
        nao = BatchedNao(2, seed=0, ball=True, spread=IDENTICAL, num_threads=1)
        ball = np.array([[0.19, 0.05], [0.19, -0.05]])
        nao.reset(np.arange(2), np.zeros((2, 3)), np.random.default_rng(0), ball)
        fastest: Floats = np.zeros(2)
        for _ in range(8):
            near = nao.ball[:, 0] - nao.pose[:, 0] < 0.21
            nao.step(np.tile([0.05, 0.0, 0.0], (2, 1)), kick=near & kick)
            fastest = np.maximum(fastest, nao.ball_velocity[:, 0])
        speeds[kick] = fastest
        assert not nao.fallen.any()
    assert (speeds[True] > 0.7).all()
    assert (speeds[True] < 2.0).all()
    assert (speeds[True] > speeds[False] + 0.3).all()


@pytest.mark.parametrize("side", [1, -1])
def test_balls_are_kicked_by_the_foot_on_their_side_wherever_the_robot_looks(side: int) -> None:
    yaw = np.array([0.0, 1.5, 3.0, -1.5])
    nao = BatchedNao(4, seed=0, ball=True, spread=IDENTICAL, num_threads=1)
    ball = np.exp(1j * yaw) * (0.3 + 0.06j * side)
    nao.reset(
        np.arange(4),
        np.column_stack([np.zeros((4, 2)), yaw]),
        np.random.default_rng(0),
        np.column_stack([ball.real, ball.imag]),
    )
    kicked = np.zeros(4, dtype=bool)
    for _ in range(8):
        nao.step(np.zeros((4, 3)), kick=np.ones(4, dtype=bool))
        gait = nao.gait
        kicked |= gait.kicking
        assert (gait.left_swings[gait.kicking] == (side > 0)).all()
    assert kicked.all()
