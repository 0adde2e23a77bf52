from dataclasses import replace

import numpy as np
import pytest
from nao_values import NO_ERRORS
from numpy.typing import NDArray

from astra_data.robots.nao.tasks import BallSight, Localisation, PerceptionErrors

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


def test_estimates_are_as_old_as_told_and_the_ball_is_where_it_seems_from_there() -> None:
    rng = np.random.default_rng(0)
    place, sight = Localisation(1, replace(NO_ERRORS, latency_s=STEP_S / 2), STEP_S), BallSight(1, NO_ERRORS, STEP_S)
    place.reset(np.arange(1), np.array([[0.0, 0.0, 3.1]]), rng)
    place.update(np.array([[0.2, 0.4, -3.0]]), rng, everyone(1))
    assert place.pose[0].tolist() == pytest.approx([0.1, 0.2, -3.0 - (2 * np.pi - 6.1) / 2])
    sight.update(np.array([[1.0, 0.0]]), np.zeros((1, 3)), np.array([[1.0, 2.0, np.pi / 2]]), rng, everyone(1))
    assert sight.position[0].tolist() == pytest.approx([1.0, 3.0])


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
    apart = round(2.0 / STEP_S)  # errors 2 s apart are correlated by 1 / e
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
    assert len(jumps) / (ROBOTS * 50 * STEP_S / 60) == pytest.approx(5.0, rel=0.1) and min(jumps) >= 0.1 - 1e-9
    assert max(jumps) <= 0.3 + 1e-9


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


@pytest.mark.parametrize("heading", [0.0, 3.0, -3.0])
@pytest.mark.parametrize(("bearing_deg", "seen"), [(99, True), (-99, True), (101, False), (-101, False)])
def test_a_ball_is_seen_up_to_100_degrees_to_either_side(heading: float, bearing_deg: float, seen: bool) -> None:
    sight = BallSight(1, PerceptionErrors(ball_missed=0.0), STEP_S)
    sight.reset(np.array([0]), np.zeros((1, 2)))
    angle = np.arctan2(np.sin(heading + np.radians(bearing_deg)), np.cos(heading + np.radians(bearing_deg)))
    ball, pose = np.array([[np.cos(angle), np.sin(angle)]]), np.array([[0.0, 0.0, heading]])
    sight.update(ball, pose, pose, np.random.default_rng(0), everyone(1))
    assert (sight.unseen_s[0] == 0.0) == seen


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
