import numpy as np
import pytest

from astra_data.core.arrays import Floats
from astra_data.robots.nao.kinematics import GRAVITY, HIP_OFFSET_Y_M, HIP_OFFSET_Z_M, TICK_S, foot_poses
from astra_data.robots.nao.walk import (
    START,
    STOP,
    STRIDE,
    Gait,
    StepPlanner,
    WalkEngine,
    WalkLimits,
    WalkStyle,
)

STYLE = WalkStyle(step_scale=(1.0, 1.0, 1.0))
LIMITS = WalkLimits()


def engine(count: int = 1, style: WalkStyle = STYLE) -> WalkEngine:
    return WalkEngine(StepPlanner(np.ones(count), LIMITS), style)


def striding(**changes: object) -> Gait:
    """Return a robot amid a stride of its left foot, straight on by 4 cm from step to step."""
    gait = Gait.standing(1, LIMITS)
    gait.walking[:], gait.kind[:], gait.left_swings[:] = True, STRIDE, True
    gait.before[:], gait.after[:] = [[0.04, 0.0, 0.0]], [[0.04, 0.0, 0.0]]
    for name, value in changes.items():
        getattr(gait, name)[:] = value
    return gait


def feet_at(phase: float, **changes: object) -> Floats:
    return np.asarray(engine().feet(striding(phase=phase, **changes))[0])


def test_standing_feet_are_beneath_the_hips() -> None:
    left, right = engine().feet(Gait.standing(1, LIMITS))[0]
    height = -STYLE.hip_height_m - HIP_OFFSET_Z_M
    assert left == pytest.approx([-STYLE.torso_ahead_m, HIP_OFFSET_Y_M, height, 0, 0, 0])
    assert right == pytest.approx([-STYLE.torso_ahead_m, -HIP_OFFSET_Y_M, height, 0, 0, 0])


def test_the_supporting_foot_moves_back_evenly_and_the_swinging_one_comes_forward() -> None:
    ahead = -STYLE.torso_ahead_m
    for phase, supporting, swinging in ((0.0, 0.02, -0.02), (0.5, 0.0, 0.0), (1.0, -0.02, 0.02)):
        left, right = feet_at(phase)
        assert right[0] == pytest.approx(ahead + supporting, abs=1e-12)
        assert left[0] == pytest.approx(ahead + swinging, abs=1e-12)
    quarter = [feet_at(phase)[1][0] for phase in (0.0, 0.25, 0.5)]
    assert quarter[1] == pytest.approx((quarter[0] + quarter[2]) / 2)
    # The swinging foot starts and lands at rest: 1 - cos.
    assert feet_at(0.25)[0][0] == pytest.approx(ahead - 0.02 + 0.04 * (1 - 0.5**0.5) / 2)


def test_each_direction_of_a_step_has_its_own_scale() -> None:
    scaled, spread = engine(style=WalkStyle(step_scale=(1.1, 1.3, 0.9))), [[0.04, 0.1, 0.0]]
    left, right = scaled.feet(striding(phase=1.0, before=spread, after=spread))[0]
    assert left[0] - right[0] == pytest.approx(1.1 * 0.04)
    assert left[1] - right[1] == pytest.approx(2 * HIP_OFFSET_Y_M + 1.3 * 0.1)
    turn = [[0.0, 0.0, 0.4]]
    left, right = scaled.feet(striding(phase=1.0, before=turn, after=turn))[0]
    assert left[5] - right[5] == pytest.approx(0.9 * 0.4)


def test_only_the_swinging_foot_is_lifted_and_most_in_the_middle() -> None:
    ground = -STYLE.hip_height_m - HIP_OFFSET_Z_M
    heights = np.array([feet_at(phase)[:, 2] for phase in (0.0, 1 / 6, 0.5, 1.0)]) - ground
    np.testing.assert_allclose(heights[:, 0], STYLE.lift_m * np.array([0.0, 0.5, 1.0, 0.0]), atol=1e-12)
    np.testing.assert_allclose(heights[:, 1], 0.0, atol=1e-12)
    mirrored = feet_at(0.5, left_swings=False)[:, 2] - ground
    np.testing.assert_allclose(mirrored, [0.0, STYLE.lift_m], atol=1e-12)
    for kind in (START, STOP):
        assert not (feet_at(0.5, kind=kind)[:, 2] - ground).any()


def test_a_kick_swings_the_foot_beyond_its_step_and_back() -> None:
    plain, kick = (feet_at(0.5, kicking=kicking) for kicking in (False, True))
    assert kick[0, 0] - plain[0, 0] == pytest.approx(STYLE.kick_reach_m)
    assert kick[1, 0] == plain[1, 0]
    assert feet_at(1.0, kicking=True)[0, 0] == pytest.approx(feet_at(1.0)[0, 0], abs=1e-9)


def test_turned_feet_stand_on_a_circle_around_the_torso() -> None:
    spread = [[0.0, 0.0, 0.4]]
    left, right = feet_at(0.0, before=spread, after=spread)
    assert (left[5], right[5]) == pytest.approx((-0.2, 0.2))
    sway = (left[1] + right[1]) / 2
    for foot, side, yaw in ((left, 1, -0.2), (right, -1, 0.2)):
        assert foot[0] + STYLE.torso_ahead_m == pytest.approx(-side * HIP_OFFSET_Y_M * np.sin(yaw))
        assert foot[1] - sway == pytest.approx(side * HIP_OFFSET_Y_M * np.cos(yaw))


def test_the_torso_sways_as_a_pendulum_on_the_supporting_foot() -> None:
    rate = np.sqrt(GRAVITY / STYLE.pendulum_m)
    duration, dt = LIMITS.step_s, 1e-3
    phases = (np.array([-1, 0, 1])[:, None] * dt + np.linspace(0.1, 0.9, 9) * duration) / duration

    def torso(phase: float) -> float:
        # Feet are told seen from the torso: where it sways to, they come from.
        return -float(feet_at(phase)[:, 1].sum()) / 2

    sway = np.array([[torso(phase) for phase in row] for row in phases])
    assert torso(0.0) == pytest.approx(0.0, abs=1e-12) and torso(1.0) == pytest.approx(0.0, abs=1e-12)
    # The left foot swings: it sways to the right foot, which is at -5 cm, and y'' = rate² (y - foot).
    assert sway.min() > -0.05 and sway.max() < 0
    acceleration = (sway[0] - 2 * sway[1] + sway[2]) / dt**2
    np.testing.assert_allclose(acceleration, rate**2 * (sway[1] + STYLE.sway_foot_m), rtol=1e-3)


def test_the_torso_is_a_pendulum_on_the_supporting_foot_in_steps_to_the_side_too() -> None:
    style, dt = WalkStyle(), 1e-3
    assert style.sway_foot_m == HIP_OFFSET_Y_M
    phases = np.linspace(0.1, 0.9, 9) + np.array([-1, 0, 1])[:, None] * dt / LIMITS.step_s
    step = {"before": [[0.0, 0.02, 0.0]], "after": [[0.0, 0.06, 0.0]]}

    def right_foot(phase: float) -> float:
        return float(engine(style=style).feet(striding(phase=phase, **step))[0, 1, 1])

    right = np.array([[right_foot(phase) for phase in row] for row in phases])
    acceleration = (right[0] - 2 * right[1] + right[2]) / dt**2
    np.testing.assert_allclose(acceleration, GRAVITY / style.pendulum_m * right[1], rtol=1e-3)


def test_first_and_last_step_lead_from_rest_to_the_strides_speed_and_back() -> None:
    dt = 1e-5

    def speed(phase: float, **changes: object) -> float:
        places = [-feet_at(phase + sign * dt, **changes)[:, 1].sum() / 2 for sign in (-1, 1)]
        return float(places[1] - places[0]) / (2 * dt * LIMITS.step_s)

    # A start step leans over the foot that the stride after it stands on the other side of.
    start = [speed(phase, kind=START, left_swings=False) for phase in (dt, 1 - dt)]
    stride = [speed(phase, left_swings=True) for phase in (dt, 1 - dt)]
    stop = [speed(phase, kind=STOP, left_swings=False) for phase in (dt, 1 - dt)]
    assert start[0] == pytest.approx(0.0, abs=1e-3) and stop[1] == pytest.approx(0.0, abs=1e-3)
    assert start[1] == pytest.approx(stride[0], rel=1e-2)
    assert stop[0] == pytest.approx(stride[1], rel=1e-2)


def test_targets_are_the_angles_of_the_planned_feet_tick_by_tick() -> None:
    command = np.array([[0.2, 0.0, 0.0]])
    walking, again = Gait.standing(1, LIMITS), Gait.standing(1, LIMITS)
    targets = engine().advance(walking, command, 40)
    assert targets.angles.shape == (1, 40, 11)
    assert len(targets.gaits) == 41
    for tick in range(40):
        engine().planner.advance(again, command, TICK_S)
        np.testing.assert_allclose(
            foot_poses(targets.angles[0, tick])[:, :5], engine().feet(again)[0][:, :5], atol=1e-9
        )
        assert targets.supports[0, tick].tolist() == [not again.left_swings[0], bool(again.left_swings[0])]
    reached = targets.reached(np.array([17]))
    for name, value in vars(targets.gaits[17]).items():
        np.testing.assert_array_equal(getattr(reached, name), value)
    assert vars(targets.reached(np.array([40])))["phase"] == walking.phase


def test_feet_lift_off_in_turn_at_the_begin_of_strides() -> None:
    targets = engine().advance(Gait.standing(1, LIMITS), np.array([[0.2, 0.0, 0.0]]), 100)
    lifts = targets.lifts_off[0][targets.lifts_off[0] != 0].tolist()
    assert lifts[:4] in ([1, -1, 1, -1], [-1, 1, -1, 1])
    assert not engine().advance(Gait.standing(1, LIMITS), np.zeros((1, 3)), 50).lifts_off.any()


def test_a_kick_waits_for_the_foot_that_is_asked_for_and_keeps_the_robot_stepping() -> None:
    for asked, swings_left in (([True, False], True), ([False, True], False)):
        gait = Gait.standing(1, LIMITS)
        targets = engine().advance(gait, np.zeros((1, 3)), 120, np.array([asked]))
        kicking = [bool(gait.left_swings[0]) for gait in targets.gaits if gait.kicking[0]]
        assert kicking and set(kicking) == {swings_left}
    still = engine().advance(Gait.standing(1, LIMITS), np.zeros((1, 3)), 120, np.array([[False, False]]))
    assert not any(gait.walking[0] for gait in still.gaits)


def test_kicks_wait_for_the_first_stride() -> None:
    targets = engine().advance(Gait.standing(1, LIMITS), np.zeros((1, 3)), 60, np.array([[True, True]]))
    kicking = [gait for gait in targets.gaits if gait.kicking[0]]
    assert kicking and {int(gait.kind[0]) for gait in kicking} == {STRIDE}
