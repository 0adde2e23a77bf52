import mujoco
import numpy as np
import pytest
from nao_values import foot_poses

from astra_data.core.arrays import Floats
from astra_data.robots.nao import walk

STANDING_Z_M = -0.230 - walk.HIP_OFFSET_Z_M


def random_poses(count: int) -> Floats:
    """Return pairs of feet (N, 2, 6) within a step's reach, tilted every way."""
    rng = np.random.default_rng(1)
    middle = np.array([0.0, 0.0, STANDING_Z_M + 0.02, 0.0, 0.0, 0.0])
    reach = np.array([0.06, 0.04, 0.015, 0.15, 0.15, 0.4])
    poses = middle + reach * rng.uniform(-1, 1, (count, 2, 6))
    poses[..., 1] += np.array([walk.HIP_OFFSET_Y_M, -walk.HIP_OFFSET_Y_M])
    return np.asarray(poses)


def normal(pose: Floats) -> Floats:
    """Return the sole's normal at a pose (6,)."""
    quaternion, up = np.zeros(4), np.zeros(3)
    mujoco.mju_euler2Quat(quaternion, pose[3:], "XYZ")
    mujoco.mju_rotVecQuat(up, np.array([0.0, 0.0, 1.0]), quaternion)
    return up


def test_angles_bring_the_feet_where_they_should_be() -> None:
    poses = random_poses(500)
    reached = foot_poses(walk.leg_angles(poses))
    np.testing.assert_allclose(reached[..., :3], poses[..., :3], atol=1e-9)
    for found, wanted in zip(reached.reshape(-1, 6), poses.reshape(-1, 6), strict=True):
        np.testing.assert_allclose(normal(found), normal(wanted), atol=1e-9)


def test_feet_turned_against_each_other_reach_their_yaw() -> None:
    poses = random_poses(200)  # what one motor can do: mirror images
    poses[:, 1] = poses[:, 0] * [1, -1, 1, -1, 1, -1]
    np.testing.assert_allclose(foot_poses(walk.leg_angles(poses)), poses, atol=1e-9)


def test_each_trait_has_its_own_range() -> None:
    spread = walk.TraitSpread(
        joint_offset_deg=2.0, stiffness_loss=0.4, delay_ticks=(1, 4), friction=(0.2, 0.3), quality=(0.5, 0.6)
    )
    traits = walk.Traits.draw(spread, 4000, np.random.default_rng(0))
    assert np.degrees(traits.joint_offset_rad).std() == pytest.approx(2.0, rel=0.02)
    assert np.degrees(traits.joint_offset_rad).mean() == pytest.approx(0.0, abs=0.05)
    for values, low, high in ((traits.stiffness, 0.6, 1.0), (traits.friction, 0.2, 0.3), (traits.quality, 0.5, 0.6)):
        assert low <= values.min() and values.max() <= high
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.03 * (high - low))
    assert np.unique(traits.delay_ticks).tolist() == [1, 2, 3, 4]


NEW, NOBODY = np.ones(1), np.zeros(1, bool)
STYLE = walk.WalkStyle(step_scale=(1.0, 1.0, 1.0))


@pytest.fixture(autouse=True)
def plain_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(walk, "STYLE", STYLE)


def one(*command: float) -> Floats:
    return np.array([command])


def strides(command: Floats, seconds: float, gait: walk.Gait | None = None) -> list[walk.Gait]:
    """Return the gait at the begin of each stride."""
    gait = gait or walk.Gait.standing(1)
    seen = []
    for _ in range(round(seconds / walk.TICK_S)):
        begins = walk.tick(gait, command, NEW, NOBODY)
        if begins[0] and gait.kind[0] == walk.STRIDE:
            seen.append(walk.Gait(**{name: value.copy() for name, value in vars(gait).items()}))
    return seen


@pytest.mark.parametrize(
    ("command", "attained"),
    [
        ((0.9, 0, 0), (0.25, 0, 0)),
        ((-0.9, 0, 0), (-0.15, 0, 0)),
        ((0, 0.9, 0), (0, 0.2, 0)),
        ((0, 0, -9.0), (0, 0, -np.radians(120))),
        ((0.1, 0.05, 0), (0.1, 0.05, 0)),
        ((0.25, 0.2, 0), (0.25 * 0.5**0.5, 0.2 * 0.5**0.5, 0)),  # on the ellipse
        # A turn that leaves nothing of the forward speed: 24 degrees in the wider step.
        ((0.25, 0, np.radians(24) / 0.5 / 0.67), (0, 0, np.radians(24) / 0.5 / 0.67)),
        ((0.25, 0, np.radians(12) / 0.5 / 0.67), (0.25 * 0.75, 0, np.radians(12) / 0.5 / 0.67)),
        # Half of the 45.4 degrees at which nothing is left of the sideways speed.
        ((0, 0.2, np.radians(22.7) / 0.5 / 0.67), (0, 0.2 * 0.75, np.radians(22.7) / 0.5 / 0.67)),
    ],
)
def test_attainable_speeds(command: tuple[float, ...], attained: tuple[float, ...]) -> None:
    np.testing.assert_allclose(walk.attainable(one(*command), NEW), [attained], atol=1e-12)
    worn = walk.attainable(np.array([[0.9, 0, 0], [0, -0.9, 0], [0, 0, -9.0]]), np.array([0.5]))
    np.testing.assert_allclose(worn, np.diag([0.125, -0.1, -np.radians(60)]), atol=1e-12)


def test_forward_speed_is_gained_slowly_and_lost_fast() -> None:
    speeds = [float(gait.forward_m_s[0]) for gait in strides(one(0.25, 0, 0), 2.0)]
    np.testing.assert_allclose(speeds[:4], [0.075, 0.15, 0.225, 0.25])
    walking = strides(one(0.25, 0, 0), 2.0)[-1]
    back = [float(gait.forward_m_s[0]) for gait in strides(one(-0.15, 0, 0), 1.0, walking)]
    np.testing.assert_allclose(back[:3], [-0.05, -0.125, -0.15])
    slow = strides(one(0.15, 0, 0), 2.0)[-1]  # beyond zero it is a gain
    assert strides(one(-0.15, 0, 0), 1.0, slow)[0].forward_m_s[0] == pytest.approx(-0.075)


def test_the_leading_foot_goes_aside_and_the_other_follows() -> None:
    for sign in (1, -1):
        seen = strides(one(0, sign * 0.2, 0), 3.0)
        assert seen[0].left_swings[0] == (sign > 0)
        for gait in seen:
            leads = gait.left_swings[0] == (sign > 0)
            assert gait.duration_s[0] == pytest.approx(0.28)  # 0.25 s and 0.15 ms per mm/s
            assert gait.after[0, 1] == pytest.approx(sign * 0.2 * 0.56 if leads else 0.0)


def test_a_turn_is_split_between_wide_and_narrow_steps() -> None:
    seen = strides(one(0, 0, 1.0), 3.0)
    wide, narrow = seen[2].after[0, 2], seen[3].after[0, 2]
    assert wide == pytest.approx(0.67 * 2 * 0.25) and narrow == pytest.approx(0.33 * 2 * 0.25)
    assert seen[2].left_swings[0] and not seen[3].left_swings[0]


def test_walking_begins_and_ends_with_a_shift_of_weight() -> None:
    gait, kinds = walk.Gait.standing(1), []
    for tick in range(200):
        command = one(0.1, 0, 0) if tick < 100 else one(0, 0, 0)
        if walk.tick(gait, command, NEW, NOBODY)[0]:
            kinds.append(int(gait.kind[0]))
    assert kinds[0] == walk.START and kinds[-1] == walk.STOP and set(kinds[1:-1]) == {walk.STRIDE}
    assert not gait.walking[0] and (gait.after == 0).all()


def striding(**changes: object) -> walk.Gait:
    """Return a robot amid a stride of its left foot, straight on by 4 cm from step to step."""
    gait = walk.Gait.standing(1)
    gait.walking[:], gait.kind[:], gait.left_swings[:] = True, walk.STRIDE, True
    gait.before[:], gait.after[:] = [[0.04, 0.0, 0.0]], [[0.04, 0.0, 0.0]]
    for name, value in changes.items():
        getattr(gait, name)[:] = value
    return gait


def feet_at(phase: float, **changes: object) -> Floats:
    return np.asarray(walk.stance(striding(phase=phase, **changes))[0])


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


def test_the_torso_sways_as_a_pendulum_on_the_supporting_foot() -> None:
    rate = np.sqrt(walk.GRAVITY / STYLE.pendulum_m)
    duration, dt = walk.LIMITS.step_s, 1e-3
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
    # In steps aside that foot moves evenly, by half a step to either end.
    aside = {"before": [0.0, 0.02, 0.0], "after": [0.0, 0.03, 0.0]}
    sway = np.array([[walk.sway(striding(phase=phase, **aside))[0] for phase in row] for row in phases])
    foot = -STYLE.sway_foot_m + 0.01 * (1 - phases[1]) - 0.015 * phases[1]
    acceleration = (sway[0] - 2 * sway[1] + sway[2]) / dt**2
    np.testing.assert_allclose(acceleration, rate**2 * (sway[1] - foot), rtol=1e-3)


def test_targets_are_the_angles_of_the_planned_feet_tick_by_tick() -> None:
    command = one(0.2, 0.0, 0.0)
    walking, again = walk.Gait.standing(1), walk.Gait.standing(1)
    targets = walk.advance(walking, command, NEW, 40, np.zeros((1, 2), bool))
    assert targets.angles.shape == (1, 40, 11) and len(targets.gaits) == 41
    for tick in range(40):
        walk.tick(again, command, NEW, NOBODY)
        np.testing.assert_allclose(foot_poses(targets.angles[0, tick])[:, :5], walk.stance(again)[0][:, :5], atol=1e-9)
        assert targets.supports[0, tick].tolist() == [not again.left_swings[0], bool(again.left_swings[0])]
    reached = targets.reached(np.array([17]))
    for name, value in vars(targets.gaits[17]).items():
        np.testing.assert_array_equal(getattr(reached, name), value)
    assert vars(targets.reached(np.array([40])))["phase"] == walking.phase


def test_a_kick_waits_for_the_foot_that_is_asked_for_and_keeps_the_robot_stepping() -> None:
    for asked, swings_left in (([True, False], True), ([False, True], False)):
        gait = walk.Gait.standing(1)
        targets = walk.advance(gait, np.zeros((1, 3)), NEW, 120, np.array([asked]))
        kicking = {(bool(gait.left_swings[0]), int(gait.kind[0])) for gait in targets.gaits if gait.kicking[0]}
        assert kicking == {(swings_left, walk.STRIDE)}
    still = walk.advance(walk.Gait.standing(1), np.zeros((1, 3)), NEW, 120, np.array([[False, False]]))
    assert not any(gait.walking[0] for gait in still.gaits)
