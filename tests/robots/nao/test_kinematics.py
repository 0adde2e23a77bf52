import mujoco
import numpy as np

from astra_data.core.arrays import Floats
from astra_data.robots.nao.bodies import nao_model
from astra_data.robots.nao.kinematics import (
    FOOT_HEIGHT_M,
    HIP_OFFSET_Y_M,
    HIP_OFFSET_Z_M,
    JOINTS,
    THIGH_M,
    TIBIA_M,
    TO_MOTORS,
    foot_poses,
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


def test_foot_poses_are_mujocos() -> None:
    model = nao_model()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    angles = rng.uniform(-0.5, 0.5, (100, len(JOINTS)))
    poses = foot_poses(angles)
    for row, pose in zip(angles, poses, strict=True):
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        data.qpos[7:] = row[TO_MOTORS]
        mujoco.mj_kinematics(model, data)
        for side, (x, y, z, roll, pitch, yaw) in zip("LR", pose, strict=True):
            body = data.body(f"{side}AnkleRoll")
            rotation = body.xmat.reshape(3, 3)
            sole = body.xpos - FOOT_HEIGHT_M * rotation[:, 2]
            np.testing.assert_allclose([x, y, z], sole, atol=1e-9)
            quaternion, theirs = np.zeros(4), np.zeros(9)
            mujoco.mju_euler2Quat(quaternion, np.array([roll, pitch, yaw]), "XYZ")
            mujoco.mju_quat2Mat(theirs, quaternion)
            np.testing.assert_allclose(rotation, theirs.reshape(3, 3), atol=1e-9)


def test_controls_are_the_angles_names() -> None:
    model = nao_model()
    for motor, angle in enumerate(TO_MOTORS):
        assert model.actuator(motor).name.endswith(JOINTS[angle])
        assert model.actuator_trnid[motor, 0] == model.joint(model.actuator(motor).name).id


def test_angles_bring_the_feet_where_they_should_be() -> None:
    poses = random_poses(500)
    solved = leg_angles(poses)
    assert solved.reached.all()
    reached = foot_poses(solved.angles)
    np.testing.assert_allclose(reached[..., :3], poses[..., :3], atol=1e-9)
    np.testing.assert_allclose(reached[..., 5] - poses[..., 5], solved.yaw_error, atol=1e-9)
    for found, wanted in zip(reached.reshape(-1, 6), poses.reshape(-1, 6), strict=True):
        np.testing.assert_allclose(normal(found), normal(wanted), atol=1e-9)


def test_feet_turned_against_each_other_reach_their_yaw() -> None:
    # What one motor can do: mirror images.
    poses = random_poses(200)
    poses[:, 1] = poses[:, 0] * [1, -1, 1, -1, 1, -1]
    solved = leg_angles(poses)
    np.testing.assert_allclose(foot_poses(solved.angles), poses, atol=1e-9)
    np.testing.assert_allclose(solved.yaw_error, 0.0, atol=1e-9)


def test_both_feet_to_one_side_share_the_error() -> None:
    poses = random_poses(1)
    poses[:, 0] = [0.0, HIP_OFFSET_Y_M, STANDING_Z_M + 0.02, 0.0, 0.0, 0.2]
    poses[:, 1] = [0.0, -HIP_OFFSET_Y_M, STANDING_Z_M + 0.02, 0.0, 0.0, 0.2]
    np.testing.assert_allclose(leg_angles(poses).yaw_error, -0.2, atol=1e-6)


def test_angles_come_back() -> None:
    rng = np.random.default_rng(2)
    angles = rng.uniform(-0.3, 0.3, (300, len(JOINTS)))
    angles[:, [3, 8]] = rng.uniform(0.2, 1.0, (300, 2))
    np.testing.assert_allclose(leg_angles(foot_poses(angles)).angles, angles, atol=1e-8)


def test_a_foot_out_of_reach_is_told() -> None:
    poses = random_poses(1)
    poses[0, 0, 2] = -HIP_OFFSET_Z_M - THIGH_M - TIBIA_M - FOOT_HEIGHT_M - 0.01
    assert leg_angles(poses).reached.tolist() == [[False, True]]
