import mujoco
import numpy as np
import torch

from astra_data.robots.humanoid.model import COMMANDED, JOINTS, CommandRanges, humanoid_model


def test_joints_are_listed_as_the_model_lists_them() -> None:
    model = humanoid_model()
    assert tuple(model.joint(joint).name for joint in range(1, model.njnt)) == JOINTS
    assert [JOINTS[joint] for joint in COMMANDED] == ["left_hip_y", "left_knee", "right_hip_y", "right_knee"]
    # The commanded joints' actuators have the same numbers.
    assert [model.joint(model.actuator_trnid[number, 0]).name for number in COMMANDED] == [
        JOINTS[joint] for joint in COMMANDED
    ]


def test_motors_are_replaced_by_position_control_with_their_torques() -> None:
    model, motors = humanoid_model(), humanoid_model("motors")
    data, plain = mujoco.MjData(model), mujoco.MjData(motors)
    rng = np.random.default_rng(0)
    for one in (data, plain):
        one.qpos[2] = 3.0
    data.qpos[7:] = plain.qpos[7:] = angles = rng.uniform(-0.5, 0.5, 17)
    data.qvel[6:] = plain.qvel[6:] = rates = rng.uniform(-2.0, 2.0, 17)
    target = rng.uniform(-0.5, 0.5, 17)
    joints = model.actuator_trnid[:, 0] - 1
    gears = motors.actuator_gear[:, 0]
    torque = np.clip(200 * (target - angles)[joints] - 10 * rates[joints], -0.4 * gears, 0.4 * gears)
    assert 0 < (np.abs(torque) == 0.4 * gears).sum() < 17
    data.ctrl[:], plain.ctrl[:] = target[joints], torque / gears
    mujoco.mj_forward(model, data)
    mujoco.mj_forward(motors, plain)
    np.testing.assert_allclose(data.actuator_force, torque, atol=1e-12)
    np.testing.assert_allclose(data.qacc, plain.qacc, atol=1e-9)


def test_commands_span_their_ranges_and_are_clipped() -> None:
    action = torch.tensor([[-1.0, -1.0, -1.0, -1.0], [0.0, 1.0, 9.0, -9.0]])
    degrees = torch.rad2deg(CommandRanges().targets(action))
    expected = torch.tensor([[-50.0, -70.0, -50.0, -70.0], [-15.0, -2.0, 20.0, -70.0]])
    torch.testing.assert_close(degrees, expected)
