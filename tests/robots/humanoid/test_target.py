from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.robots.humanoid import target as humanoid
from astra_data.robots.humanoid.target import COMMANDED, JOINTS, HumanoidEnv, Locomotion, humanoid_model


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
    degrees = torch.rad2deg(humanoid.commanded_angles(action))
    expected = torch.tensor([[-50.0, -70.0, -50.0, -70.0], [-15.0, -2.0, 20.0, -70.0]])
    torch.testing.assert_close(degrees, expected)


def theirs(seed: int) -> Any:
    env = gymnasium.make("Humanoid-v5").unwrapped
    env.reset(seed=seed)
    return env


def make(num_envs: int, locomotion: Locomotion | None = None, **options: Any) -> HumanoidEnv:
    return HumanoidEnv(locomotion or Locomotion(), num_envs, seed=0, **{"num_threads": 1, **options})


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_equals_gymnasiums_humanoid_step_for_step(scale: float) -> None:
    env = theirs(seed=3)
    rng = np.random.default_rng(0)
    ours = make(3, actuators="motors", num_threads=2)
    state = np.concatenate([env.data.qpos, env.data.qvel])
    ours.reset_to(np.arange(3), np.tile(state, (3, 1)))
    ended = False
    for _ in range(80):
        control = rng.uniform(-0.4 * scale, 0.4 * scale, (3, 17))
        step = ours.drive(control)
        observation, reward, terminated, _, _ = env.step(control[1])
        found = np.concatenate([ours.physics.qpos[1, 2:], ours.physics.qvel[1]])
        np.testing.assert_allclose(found, observation[:45], rtol=0, atol=1e-9)
        assert float(step.reward[1]) == pytest.approx(reward, rel=1e-6) and bool(step.terminated[1]) == terminated
        ended |= terminated
    assert ended  # so that both heights were seen
    env.close()


def test_contacts_and_effort_cost() -> None:
    rewards = []
    for task in (Locomotion(), Locomotion(effort_cost=0.0, contact_cost=0.0), Locomotion(contact_cost=1.0)):
        env = make(1, task, actuators="motors")
        env.drive(np.full((1, 17), 0.2))
        env.reset_to(np.arange(1), env.state.numpy() - np.eye(47)[[2]] * 0.15)  # feet into the floor
        rewards.append(float(env.drive(np.full((1, 17), 0.2)).reward[0]))
    paid, unpaid, most = rewards
    assert unpaid - paid > 0.1 * 17 * 0.2**2 + 1e-4
    assert unpaid - most == pytest.approx(0.1 * 17 * 0.2**2 + 10.0, rel=1e-6)  # clipped


def test_position_control_costs_its_torques_in_units_of_the_motors() -> None:
    env = make(1)
    state = env.state.numpy()
    state[0, 2] = 1.8  # off the floor
    env.reset_to(np.arange(1), state)
    step = env.drive(np.full((1, 17), 100.0))  # so far away that every motor gives all it has
    assert 5.0 - float(step.reward[0]) == pytest.approx(0.1 * 17 * 0.4**2, abs=0.05)


def test_starts_are_upright_and_almost_at_rest() -> None:
    env = make(200)
    observation = env.reset()
    assert observation.shape == (200, 45) and torch.equal(observation, env.state[:, 2:])
    upright = torch.zeros(47)
    upright[2], upright[3] = 1.4, 1.0
    offset = (env.state - upright).abs()
    assert 0.009 < float(offset.max()) <= 0.01 + 1e-4 and float(offset.std()) > 0.002
    torch.testing.assert_close(env.state[:, 3:7].norm(dim=1), torch.ones(200))


def test_commands_reach_the_joints_they_name() -> None:
    env = make(5)
    state = env.state.numpy().astype(np.float64)
    state[:, 2] = 3.0  # in free fall, away from the floor
    env.reset_to(np.arange(5), state)
    # The first three hold hips and knees at zero as far as they can; each other command bends one joint.
    rest = torch.tensor([3 / 7, 1.0, 3 / 7, 1.0])
    action = rest.repeat(5, 1)
    for joint in range(4):
        action[joint, joint] = -0.5
    for _ in range(15):
        env.step(action)
    joints = env.state[:, 7:24]
    moved = (joints[:4] - joints[4]).abs().argmax(dim=1)
    assert moved.tolist() == [9, 10, 5, 6]  # of the 17 joints: left hip and knee, right hip and knee


def test_what_is_not_for_a_humanoid_is_refused() -> None:
    with pytest.raises(BadInputError, match="start: expected 'task' for a humanoid, got 'anywhere'"):
        HumanoidEnv(Locomotion(), 1, seed=0, start_anywhere=True)


@pytest.mark.parametrize(("height", "failed"), [(0.95, True), (1.05, False), (1.95, False), (2.05, True)])
def test_heights_outside_of_the_range_end_an_episode(height: float, failed: bool) -> None:
    env = make(2)
    state = env.state.numpy().astype(np.float64)
    state[0, 2] = height
    state[0, 7 + 10] = state[0, 7 + 6] = -1.5  # legs drawn up, so that they do not push off
    state[0, 7 + 9] = state[0, 7 + 5] = -1.5
    env.reset_to(np.arange(2), state)
    assert not env.failed.any()
    step = env.step(torch.zeros(2, 4))
    assert env.failed.tolist() == step.terminated.tolist() == [failed, False] and not step.success.any()
    assert (float(step.reward[0]) < 3.0) == failed  # without the bonus for health
    env.reset(step.terminated)
    assert not env.failed.any()
    assert step.terminated.tolist() == [failed, False]  # what was handed out stays
    assert env.step(torch.zeros(2, 4), torch.tensor([True, False])).reward[1] == 0.0
    assert env.locomotion.healthy(np.array([1.0, 1.01, 1.99, 2.0])).tolist() == [False, True, True, False]
