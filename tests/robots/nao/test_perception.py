import numpy as np
import pytest
from nao_values import NO_ERRORS
from numpy.typing import NDArray

from astra_data.robots.nao.perception import BallSight, Localisation, PerceptionErrors

STEP_S = 0.192
ROBOTS = 4000


def everyone(count: int = ROBOTS) -> NDArray[np.bool_]:
    return np.ones(count, dtype=bool)


def test_without_errors_beliefs_are_true() -> None:
    rng = np.random.default_rng(0)
    place, sight = Localisation(5, NO_ERRORS, STEP_S), BallSight(5, NO_ERRORS, STEP_S)
    pose, ball = rng.uniform(-1, 1, (5, 3)), rng.uniform(-1, 1, (5, 2))
    place.reset(np.arange(5), pose, rng)
    sight.reset(np.arange(5), ball)
    for _ in range(10):
        pose, ball = pose + rng.normal(0, 0.05, (5, 3)), ball + np.array([0.1, -0.05])
        place.update(pose, rng, everyone(5))
        sight.update(ball, pose, place.pose, rng, everyone(5))
        np.testing.assert_allclose(place.pose[:, :2], pose[:, :2], atol=1e-12)
        np.testing.assert_allclose(np.cos(place.pose[:, 2] - pose[:, 2]), 1.0, atol=1e-12)
        np.testing.assert_allclose(sight.position, ball, atol=1e-9)
        np.testing.assert_allclose(sight.velocity, np.tile([0.1, -0.05], (5, 1)) / STEP_S, atol=1e-9)


def test_errors_are_as_large_as_told() -> None:
    rng = np.random.default_rng(0)
    errors = PerceptionErrors(jumps_per_s=0.0)
    place = Localisation(ROBOTS, errors, STEP_S)
    place.reset(np.arange(ROBOTS), np.zeros((ROBOTS, 3)), rng)
    seen = []
    for _ in range(40):
        place.update(np.zeros((ROBOTS, 3)), rng, everyone())
        seen.append(place.pose.copy())
    expected = [np.hypot(0.03, 0.005)] * 2 + [np.radians(2.0)]
    assert seen[-1].std(axis=0) == pytest.approx(expected, rel=0.04)
    # Errors 2 s apart are correlated by 1 / e.
    apart = round(2.0 / STEP_S)
    both = np.corrcoef(seen[-1][:, 2], seen[-1 - apart][:, 2])[0, 1]
    assert both == pytest.approx(np.exp(-apart * STEP_S / 2.0), abs=0.05)


def test_positions_jump_as_often_and_as_far_as_told() -> None:
    rng = np.random.default_rng(0)
    errors = PerceptionErrors(white_m=0.0, drift_m=0.0, drift_rad=0.0, latency_s=0.0)
    place = Localisation(ROBOTS, errors, STEP_S)
    place.reset(np.arange(ROBOTS), np.zeros((ROBOTS, 3)), rng)
    jumps, before = [], place.pose[:, :2]
    for _ in range(50):
        place.update(np.zeros((ROBOTS, 3)), rng, everyone())
        moved = np.linalg.norm(place.pose[:, :2] - before * np.exp(-STEP_S / 2.0), axis=1)
        jumps += moved[moved > 1e-9].tolist()
        before = place.pose[:, :2]
    assert len(jumps) / (ROBOTS * 50 * STEP_S / 60) == pytest.approx(5.0, rel=0.1)
    assert min(jumps) >= 0.1 - 1e-9
    assert max(jumps) <= 0.3 + 1e-9


def test_beliefs_are_late() -> None:
    rng = np.random.default_rng(0)
    errors = PerceptionErrors(0.0, 0.0, 0.0, jumps_per_s=0.0, latency_s=0.067)
    place = Localisation(1, errors, STEP_S)
    place.reset(np.array([0]), np.zeros((1, 3)), rng)
    for step in range(1, 5):
        place.update(np.array([[0.2 * step * STEP_S, 0.0, 0.0]]), rng, everyone(1))
        assert place.pose[0, 0] == pytest.approx(0.2 * (step * STEP_S - 0.067))


@pytest.mark.parametrize(("distance", "spread"), [(0.0, 0.012), (1.0, 0.045), (4.0, 0.106)])
def test_the_ball_is_seen_worse_from_afar(distance: float, spread: float) -> None:
    rng = np.random.default_rng(0)
    errors = PerceptionErrors(0.0, 0.0, 0.0, jumps_per_s=0.0, latency_s=0.0)
    sight = BallSight(ROBOTS, errors, STEP_S)
    ball, pose = np.tile([distance, 0.0], (ROBOTS, 1)), np.zeros((ROBOTS, 3))
    sight.reset(np.arange(ROBOTS), ball)
    for _ in range(20):
        sight.update(ball, pose, pose, rng, everyone())
    assert (sight.position - ball).std(axis=0) == pytest.approx([spread, spread], rel=0.06)


def test_a_ball_behind_the_robot_is_remembered() -> None:
    rng = np.random.default_rng(0)
    errors = PerceptionErrors(ball_missed=0.0, ball_m=0.0, ball_m_per_m=0.0)
    sight = BallSight(2, errors, STEP_S)
    pose = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi]])
    sight.reset(np.arange(2), np.tile([1.0, 0.0], (2, 1)))
    for _ in range(3):
        sight.update(np.tile([1.5, 0.0], (2, 1)), pose, pose, rng, everyone(2))
    assert sight.position[0].tolist() == pytest.approx([1.5, 0.0])
    assert sight.position[1].tolist() == [1.0, 0.0]
    assert sight.unseen_s.tolist() == pytest.approx([0.0, 3 * STEP_S])


def test_what_rests_stays_and_what_is_restored_goes_on() -> None:
    rng = np.random.default_rng(0)
    place = Localisation(2, PerceptionErrors(), STEP_S)
    place.reset(np.arange(2), np.zeros((2, 3)), rng)
    before = place.pose.copy()
    place.update(np.ones((2, 3)), rng, np.array([True, False]))
    assert (place.pose[0] != before[0]).all()
    assert (place.pose[1] == before[1]).all()
    arrays = {name: values.copy() for name, values in place.arrays().items()}
    place.update(np.ones((2, 3)), np.random.default_rng(1), everyone(2))
    again = Localisation(2, PerceptionErrors(), STEP_S)
    again.restore(arrays)
    again.update(np.ones((2, 3)), np.random.default_rng(1), everyone(2))
    np.testing.assert_array_equal(again.pose, place.pose)


def test_a_robot_that_turns_past_the_back_is_estimated_where_it_was_a_moment_ago() -> None:
    exact = PerceptionErrors(white_m=0.0, drift_m=0.0, drift_rad=0.0, jumps_per_s=0.0, latency_s=0.05)
    localisation, rng = Localisation(1, exact, 0.1), np.random.default_rng(0)
    localisation.reset(np.array([0]), np.array([[0.0, 0.0, np.pi - 0.1]]), rng)
    localisation.update(np.array([[0.2, 0.0, 0.1 - np.pi]]), rng, np.array([True]))
    x, _, heading = localisation.pose[0]
    assert x == pytest.approx(0.1)
    assert abs(heading) == pytest.approx(np.pi)


def test_estimated_headings_stay_within_a_turn() -> None:
    localisation, rng = Localisation(ROBOTS, PerceptionErrors(), STEP_S), np.random.default_rng(0)
    pose = np.zeros((ROBOTS, 3))
    pose[:, 2] = np.pi - 1e-3
    localisation.reset(np.arange(ROBOTS), pose, rng)
    localisation.update(pose, rng, everyone())
    heading = localisation.pose[:, 2]
    assert ((heading >= -np.pi) & (heading < np.pi)).all()
    assert (heading < 0).any() and (heading > 0).any()


@pytest.mark.parametrize("heading", [0.0, 3.0, -3.0])
@pytest.mark.parametrize(("bearing_deg", "seen"), [(99, True), (-99, True), (101, False), (-101, False)])
def test_a_ball_is_seen_up_to_100_degrees_to_either_side(
    heading: float, bearing_deg: float, seen: bool
) -> None:
    sight = BallSight(1, PerceptionErrors(ball_missed=0.0), STEP_S)
    sight.reset(np.array([0]), np.zeros((1, 2)))
    angle = np.arctan2(np.sin(heading + np.radians(bearing_deg)), np.cos(heading + np.radians(bearing_deg)))
    ball, pose = np.array([[np.cos(angle), np.sin(angle)]]), np.array([[0.0, 0.0, heading]])
    sight.update(ball, pose, pose, np.random.default_rng(0), everyone(1))
    assert (sight.unseen_s[0] == 0.0) == seen


def test_a_ball_is_placed_where_the_estimated_pose_sees_it() -> None:
    """Straight ahead by 1 m of a robot that takes itself to stand elsewhere, looking to the left."""
    sight = BallSight(1, NO_ERRORS, STEP_S)
    sight.reset(np.array([0]), np.zeros((1, 2)))
    pose, estimated = np.array([[5.0, 5.0, 0.0]]), np.array([[2.0, 3.0, np.pi / 2]])
    sight.update(np.array([[6.0, 5.0]]), pose, estimated, np.random.default_rng(0), everyone(1))
    assert sight.position[0].tolist() == pytest.approx([2.0, 4.0])


def test_a_balls_speed_is_that_since_it_was_last_seen_mixed_with_what_it_was() -> None:
    errors = PerceptionErrors(ball_m=0.0, ball_m_per_m=0.0, ball_missed=0.0, ball_speed_keep=0.75)
    sight, rng = BallSight(1, errors, STEP_S), np.random.default_rng(0)
    sight.reset(np.array([0]), np.array([[1.0, 0.0]]))
    ahead, behind = np.zeros((1, 3)), np.array([[0.0, 0.0, np.pi]])
    for pose in (behind, behind, ahead):
        sight.update(np.array([[1.6, 0.0]]), pose, pose, rng, everyone(1))
    # 0.6 m in three steps; a quarter of that.
    assert sight.velocity[0].tolist() == pytest.approx([0.25 * 0.6 / (3 * STEP_S), 0.0])
    sight.update(np.array([[1.6, 0.0]]), ahead, ahead, rng, everyone(1))
    assert sight.velocity[0].tolist() == pytest.approx([0.75 * 0.25 * 0.6 / (3 * STEP_S), 0.0])


def test_balls_in_view_are_missed_as_often_as_told() -> None:
    sight = BallSight(ROBOTS, PerceptionErrors(), STEP_S)
    ball, pose = np.tile([1.0, 0.0], (ROBOTS, 1)), np.zeros((ROBOTS, 3))
    sight.reset(np.arange(ROBOTS), ball)
    sight.update(ball, pose, pose, np.random.default_rng(0), everyone())
    assert (sight.unseen_s > 0).mean() == pytest.approx(0.1, abs=0.02)


def test_robots_that_rest_learn_nothing_of_their_balls_and_forget_no_time() -> None:
    sight, pose = BallSight(2, PerceptionErrors(ball_missed=0.0), STEP_S), np.zeros((2, 3))
    behind = np.tile([0.0, 0.0, np.pi], (2, 1))
    sight.reset(np.arange(2), np.tile([1.0, 0.0], (2, 1)))
    ball, rng = np.tile([1.5, 0.2], (2, 1)), np.random.default_rng(0)
    sight.update(ball, behind, behind, rng, everyone(2))
    before = {name: values.copy() for name, values in sight.arrays().items()}
    for seen_from in (behind, pose):
        sight.update(ball, seen_from, seen_from, rng, np.array([True, False]))
        for name, values in sight.arrays().items():
            np.testing.assert_array_equal(values[1], before[name][1])
    assert sight.unseen_s.tolist() == pytest.approx([0.0, STEP_S])
    assert sight.position[0] == pytest.approx(ball[0], abs=0.3)


def test_a_ball_that_is_set_anew_is_seen_without_the_error_of_the_last_one() -> None:
    sight = BallSight(1, PerceptionErrors(ball_m=0.1, ball_missed=0.0), STEP_S)
    ball, pose, rng = np.array([[1.0, 0.0]]), np.zeros((1, 3)), np.random.default_rng(0)
    sight.reset(np.array([0]), ball)
    for _ in range(5):
        sight.update(ball, pose, pose, rng, everyone(1))
    assert np.abs(sight.position - ball).max() > 0.01
    sight.errors = NO_ERRORS
    sight.reset(np.array([0]), ball)
    sight.update(ball, pose, pose, rng, everyone(1))
    np.testing.assert_allclose(sight.position, ball, atol=1e-12)
