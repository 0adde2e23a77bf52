import numpy as np
import pytest
from numpy.typing import NDArray

from astra_data.worlds.nao.robot import CONTROL_STEP_S
from astra_data.worlds.nao.surrogate import BODY_RADIUS_M, SurrogateNao, SurrogateVariation
from astra_data.worlds.plane.mazes import S_MAZE

EXACT = SurrogateVariation(
    (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (1.0, 1.0), 0.0, 0.0, 0.0, 0.0, 0.0, (1.0, 1.0), (1.0, 1.0), 0.0
)


def walk(robots: SurrogateNao, command: tuple[float, float, float], steps: int) -> NDArray[np.float64]:
    commands, path = np.tile(command, (robots.num_robots, 1)), []
    for _ in range(steps):
        robots.step(commands)
        path.append(robots.pose.copy())
    return np.array(path)


@pytest.mark.parametrize(
    ("command", "speed"),
    [
        ((0.2, 0.0, 0.0), (0.2, 0.0, 0.0)),
        ((0.0, 0.1, 0.0), (0.0, 0.1, 0.0)),
        ((0.9, 0.0, 0.0), (0.25, 0.0, 0.0)),
    ],
)
def test_without_errors_robots_walk_as_commanded_within_their_limits(
    command: tuple[float, float, float], speed: tuple[float, float, float]
) -> None:
    path = walk(SurrogateNao(3, seed=0, variation=EXACT), command, 80)
    achieved = (path[-1] - path[30]) / (49 * CONTROL_STEP_S)
    np.testing.assert_allclose(achieved, np.tile(speed, (3, 1)), atol=0.01)


def test_robots_differ_and_scatter() -> None:
    robots = SurrogateNao(500, seed=0)
    path = walk(robots, (0.15, 0.0, 0.0), 60)
    speed = np.linalg.norm(path[-1, :, :2] - path[20, :, :2], axis=1) / (39 * CONTROL_STEP_S)
    assert 0.14 < speed.mean() < 0.19
    assert speed.std() > 0.01
    assert path[-1, :, 2].std() > 0.1


def test_walls_stop_robots_and_are_told() -> None:
    robots = SurrogateNao(1, seed=0, maze=S_MAZE, variation=EXACT)
    start = np.array([[*S_MAZE.cell_centre(1, 1), np.pi / 2]])
    robots.reset(np.array([0]), start, np.random.default_rng(0))
    touched = []
    for _ in range(40):
        robots.step(np.array([[0.2, 0.0, 0.0]]))
        touched.append(bool(robots.touching[0]))
    assert not touched[0]
    assert touched[-1]
    assert robots.pose[0, 1] - start[0, 1] == pytest.approx(0.5 - BODY_RADIUS_M, abs=0.051)


def test_a_ball_within_reach_is_kicked_and_others_are_not() -> None:
    balls = np.array([[0.2, 0.0], [0.2, 0.0], [0.3, 0.0], [-0.2, 0.0], [0.0, 0.2]])
    robots = SurrogateNao(5, seed=0, ball=True, variation=EXACT)
    robots.reset(np.arange(5), np.zeros((5, 3)), np.random.default_rng(0), balls)
    robots.step(np.zeros((5, 3)), kick=np.array([True, False, True, True, True]))
    # Kicked; not asked to; too far; behind; beside.
    speed = np.linalg.norm(robots.ball_velocity, axis=1)
    assert speed == pytest.approx([1.0 - 0.3 * CONTROL_STEP_S, 0.0, 0.0, 0.0, 0.0])
    assert robots.ball_velocity[0, 0] == pytest.approx(speed[0])
    assert robots.gait.walking.tolist() == [True, False, True, True, True]


def test_a_ball_that_is_walked_into_rolls_away() -> None:
    robots = SurrogateNao(1, seed=0, ball=True, variation=EXACT)
    robots.reset(np.array([0]), np.zeros((1, 3)), np.random.default_rng(0), np.array([[0.4, 0.0]]))
    for _ in range(100):
        robots.step(np.array([[0.2 if robots.ball[0, 0] < 0.41 else 0.0, 0.0, 0.0]]))
    # From where it was touched, 1 m/s carry it 1 / (2 * 0.3) m.
    assert robots.ball[0].tolist() == pytest.approx([0.4 + 1.0 / 0.6, 0.0], abs=0.06)
    assert np.abs(robots.ball_velocity).max() == 0


def test_only_active_robots_move_and_all_of_it_can_be_resumed() -> None:
    robots, again = (SurrogateNao(4, seed=3, ball=True) for _ in range(2))
    walk(robots, (0.2, 0.05, 0.3), 5)
    before = robots.pose.copy()
    robots.step(np.tile([0.2, 0.0, 0.0], (4, 1)), np.array([True, False, True, False]))
    assert (robots.pose[[1, 3]] == before[[1, 3]]).all()
    assert (robots.pose[[0, 2]] != before[[0, 2]]).any()
    again.load_state_dict(robots.state_dict())
    assert (walk(again, (0.1, 0.0, 0.1), 5) == walk(robots, (0.1, 0.0, 0.1), 5)).all()
