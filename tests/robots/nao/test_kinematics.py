import mujoco
import numpy as np
import pytest
from nao_values import foot_poses

from astra_data.core.arrays import Floats
from astra_data.robots.nao.kinematics import (
    HIP_OFFSET_Y_M,
    HIP_OFFSET_Z_M,
    Traits,
    TraitSpread,
    leg_angles,
)

STANDING_Z_M = -0.230 - HIP_OFFSET_Z_M


def random_poses(count: int) -> Floats:
    """Return pairs of feet (N, 2, 6) within a step's reach, tilted every way."""
    rng = np.random.default_rng(1)
    middle = np.array([0.0, 0.0, STANDING_Z_M + 0.02, 0.0, 0.0, 0.0])
    reach = np.array([0.06, 0.04, 0.015, 0.15, 0.15, 0.4])
    poses = middle + reach * rng.uniform(-1, 1, (count, 2, 6))
    poses[..., 1] += np.array([HIP_OFFSET_Y_M, -HIP_OFFSET_Y_M])
    return np.asarray(poses)


def normal(pose: Floats) -> Floats:
    """Return the sole's normal at a pose (6,)."""
    quaternion, up = np.zeros(4), np.zeros(3)
    mujoco.mju_euler2Quat(quaternion, pose[3:], "XYZ")
    mujoco.mju_rotVecQuat(up, np.array([0.0, 0.0, 1.0]), quaternion)
    return up


def test_angles_bring_the_feet_where_they_should_be() -> None:
    poses = random_poses(500)
    reached = foot_poses(leg_angles(poses))
    np.testing.assert_allclose(reached[..., :3], poses[..., :3], atol=1e-9)
    for found, wanted in zip(reached.reshape(-1, 6), poses.reshape(-1, 6), strict=True):
        np.testing.assert_allclose(normal(found), normal(wanted), atol=1e-9)


def test_feet_turned_against_each_other_reach_their_yaw() -> None:
    # What one motor can do: mirror images.
    poses = random_poses(200)
    poses[:, 1] = poses[:, 0] * [1, -1, 1, -1, 1, -1]
    np.testing.assert_allclose(foot_poses(leg_angles(poses)), poses, atol=1e-9)


def test_each_trait_has_its_own_range() -> None:
    spread = TraitSpread(
        joint_offset_deg=2.0, stiffness_loss=0.4, delay_ticks=(1, 4), friction=(0.2, 0.3), quality=(0.5, 0.6)
    )
    traits = Traits.draw(spread, 4000, np.random.default_rng(0))
    assert np.degrees(traits.joint_offset_rad).std() == pytest.approx(2.0, rel=0.02)
    assert np.degrees(traits.joint_offset_rad).mean() == pytest.approx(0.0, abs=0.05)
    for values, low, high in (
        (traits.stiffness, 0.6, 1.0),
        (traits.friction, 0.2, 0.3),
        (traits.quality, 0.5, 0.6),
    ):
        assert low <= values.min() and values.max() <= high
        # Uniform: mean and standard deviation of a uniform distribution.
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.03 * (high - low))
        assert values.std() == pytest.approx((high - low) / 12**0.5, rel=0.03)
    assert np.unique(traits.delay_ticks).tolist() == [1, 2, 3, 4]
