import numpy as np
import pytest

from astra_data.core.arrays import Floats
from astra_data.robots.nao.walk import START, STOP, STRIDE, Gait, StepPlanner, WalkLimits

LIMITS = WalkLimits()
TICK_S = 0.012


def planner(*quality: float) -> StepPlanner:
    return StepPlanner(np.array(quality))


def one(*command: float) -> Floats:
    return np.array([command])


def strides(command: Floats, seconds: float, gait: Gait | None = None) -> list[Gait]:
    """Return the gait at the begin of each stride."""
    gait = gait or Gait.standing(1, LIMITS)
    seen = []
    for _ in range(round(seconds / TICK_S)):
        begins = planner(1.0).advance(gait, command, TICK_S)
        if begins[0] and gait.kind[0] == STRIDE:
            seen.append(Gait(**{name: value.copy() for name, value in vars(gait).items()}))
    return seen


@pytest.mark.parametrize(
    ("command", "attained"),
    [
        ((0.9, 0, 0), (0.25, 0, 0)),
        ((-0.9, 0, 0), (-0.15, 0, 0)),
        ((0, 0.9, 0), (0, 0.2, 0)),
        ((0, 0, -9.0), (0, 0, -np.radians(120))),
        ((0.1, 0.05, 0), (0.1, 0.05, 0)),
        # On the ellipse.
        ((0.25, 0.2, 0), (0.25 * 0.5**0.5, 0.2 * 0.5**0.5, 0)),
        # A turn that leaves nothing of the forward speed: 24 degrees in the wider step.
        ((0.25, 0, np.radians(24) / 0.5 / 0.67), (0, 0, np.radians(24) / 0.5 / 0.67)),
        ((0.25, 0, np.radians(12) / 0.5 / 0.67), (0.25 * 0.75, 0, np.radians(12) / 0.5 / 0.67)),
        # Half of the 45.4 degrees at which nothing is left of the sideways speed.
        ((0, 0.2, np.radians(22.7) / 0.5 / 0.67), (0, 0.2 * 0.75, np.radians(22.7) / 0.5 / 0.67)),
    ],
)
def test_attainable_speeds(command: tuple[float, ...], attained: tuple[float, ...]) -> None:
    np.testing.assert_allclose(planner(1.0).attainable(one(*command)), [attained], atol=1e-12)


def test_a_worn_robot_is_slower() -> None:
    command = np.array([[0.9, 0.0, 0.0], [0.9, 0.0, 0.0]])
    np.testing.assert_allclose(planner(1.0, 0.83).attainable(command)[:, 0], [0.25, 0.25 * 0.83])


def test_a_worn_robot_is_slower_in_every_direction() -> None:
    commands = np.array([[-0.9, 0.0, 0.0], [0.0, -0.9, 0.0], [0.0, 0.0, 9.0]])
    worn = planner(0.83, 0.83, 0.83).attainable(commands)
    np.testing.assert_allclose(np.diag(worn), 0.83 * np.array([-0.15, -0.2, np.radians(120)]))


def test_forward_speed_is_gained_slowly_and_lost_fast() -> None:
    speeds = [float(gait.forward_m_s[0]) for gait in strides(one(0.25, 0, 0), 2.0)]
    np.testing.assert_allclose(speeds[:4], [0.075, 0.15, 0.225, 0.25])
    walking = strides(one(0.25, 0, 0), 2.0)[-1]
    back = [float(gait.forward_m_s[0]) for gait in strides(one(-0.15, 0, 0), 1.0, walking)]
    np.testing.assert_allclose(back[:3], [-0.05, -0.125, -0.15])


def test_the_leading_foot_goes_aside_and_the_other_follows() -> None:
    for sign in (1, -1):
        seen = strides(one(0, sign * 0.2, 0), 3.0)
        assert seen[0].left_swings[0] == (sign > 0)
        for gait in seen:
            leads = gait.left_swings[0] == (sign > 0)
            # 0.25 s and 0.15 ms per mm/s.
            assert gait.duration_s[0] == pytest.approx(0.28)
            assert gait.after[0, 1] == pytest.approx(sign * 0.2 * 0.56 if leads else 0.0)


def test_a_turn_is_split_between_wide_and_narrow_steps() -> None:
    seen = strides(one(0, 0, 1.0), 3.0)
    wide, narrow = seen[2].after[0, 2], seen[3].after[0, 2]
    assert wide == pytest.approx(0.67 * 2 * 0.25)
    assert narrow == pytest.approx(0.33 * 2 * 0.25)
    assert seen[2].left_swings[0]
    assert not seen[3].left_swings[0]


def test_the_foot_on_the_inside_of_a_turn_opens_it() -> None:
    for sign in (1, -1):
        assert strides(one(0, 0, sign * 1.0), 2.0)[0].left_swings[0] == (sign > 0)


def test_steps_that_end_between_ticks_last_as_long_as_told_on_average() -> None:
    """Of 0.25 s, or 20.83 ticks, each."""
    assert len(strides(one(0.1, 0, 0), 60.0)) == pytest.approx(60.0 / 0.25, abs=1.1)


def test_planned_velocities_are_the_commanded_ones_over_two_steps() -> None:
    seen = strides(one(0.1, 0.05, 0.4), 4.0)
    mean = (seen[-1].velocity() + seen[-2].velocity()) / 2
    np.testing.assert_allclose(mean, [[0.1, 0.05, 0.4]])


def test_walking_begins_and_ends_with_a_shift_of_weight() -> None:
    gait, kinds = Gait.standing(1, LIMITS), []
    for tick in range(200):
        command = one(0.1, 0, 0) if tick < 100 else one(0, 0, 0)
        if planner(1.0).advance(gait, command, TICK_S)[0]:
            kinds.append(int(gait.kind[0]))
    assert kinds[0] == START
    assert kinds[-1] == STOP
    assert set(kinds[1:-1]) == {STRIDE}
    assert not gait.walking[0]
    assert (gait.after == 0).all()


@pytest.mark.parametrize("walked_ticks", range(100, 150, 7))
def test_feet_are_together_before_the_last_shift_of_weight(walked_ticks: int) -> None:
    gait = Gait.standing(1, LIMITS)
    for tick in range(300):
        command = one(0, 0.2, 0) if tick < walked_ticks else one(0, 0, 0)
        if planner(1.0).advance(gait, command, TICK_S)[0] and gait.kind[0] == STOP:
            assert not gait.before.any()
    assert gait.kind[0] == STOP and not gait.walking[0]


def test_robots_that_are_called_to_step_on_the_spot_do() -> None:
    gait = Gait.standing(2, LIMITS)
    for _ in range(round(2.0 / TICK_S)):
        StepPlanner(np.ones(2)).advance(gait, np.zeros((2, 3)), TICK_S, np.array([True, False]))
    assert gait.walking.tolist() == [True, False]
    assert gait.kind[0] == STRIDE
    assert (gait.velocity() == 0).all()


def test_robots_do_not_disturb_each_other() -> None:
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1, 1, (100, 5, 3)) * [0.25, 0.2, 2.0]
    together, alone = Gait.standing(5, LIMITS), Gait.standing(1, LIMITS)
    quality = rng.uniform(0.83, 1, 5)
    for command in commands:
        StepPlanner(quality).advance(together, command, TICK_S)
        StepPlanner(quality[2:3]).advance(alone, command[2:3], TICK_S)
    for name, value in vars(alone).items():
        np.testing.assert_array_equal(getattr(together, name)[2:3], value)
