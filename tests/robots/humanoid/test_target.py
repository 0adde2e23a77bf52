from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.robots.humanoid.model import Locomotion
from astra_data.robots.humanoid.target import HumanoidEnv, Humanoids


def theirs(seed: int) -> Any:  # noqa: ANN401 - Gymnasium's own
    env = gymnasium.make("Humanoid-v5").unwrapped
    env.reset(seed=seed)
    return env


@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_equals_gymnasiums_humanoid_step_for_step(scale: float) -> None:
    env = theirs(seed=3)
    rng = np.random.default_rng(0)
    ours = Humanoids(Locomotion(), 3, actuators="motors", num_threads=2)
    state = np.concatenate([env.data.qpos, env.data.qvel])
    ours.reset_to(np.arange(3), np.tile(state, (3, 1)))
    ended = False
    for _ in range(80):
        control = rng.uniform(-0.4 * scale, 0.4 * scale, (3, 17))
        ours.step(control)
        observation, reward, terminated, _, _ = env.step(control[1])
        np.testing.assert_allclose(ours.state[1, 2:], observation[:45], rtol=0, atol=1e-9)
        assert ours.reward[1] == pytest.approx(reward, rel=0, abs=1e-9)
        assert ours.healthy[1] == (not terminated)
        ended |= terminated
    assert ended  # so that both heights were seen
    env.close()


def test_contacts_and_effort_cost() -> None:
    plain, free = Locomotion(), Locomotion(effort_cost=0.0, contact_cost=0.0)
    rewards = []
    for task in (plain, free, Locomotion(contact_cost=1.0)):
        humanoids = Humanoids(task, 1, actuators="motors", num_threads=1)
        humanoids.step(np.full((1, 17), 0.2))
        humanoids.reset_to(np.arange(1), humanoids.state - np.eye(47)[2] * 0.15)  # feet into the floor
        humanoids.step(np.full((1, 17), 0.2))
        rewards.append(humanoids.reward[0])
    paid, unpaid, most = rewards
    assert unpaid - paid > 0.1 * 17 * 0.2**2 + 1e-4
    assert unpaid - most == pytest.approx(0.1 * 17 * 0.2**2 + 10.0)  # clipped


def test_position_control_costs_its_torques_in_units_of_the_motors() -> None:
    humanoids = Humanoids(Locomotion(), 1, num_threads=1)
    state = humanoids.state
    state[0, 2] = 1.8  # off the floor
    humanoids.reset_to(np.arange(1), state)
    humanoids.step(np.full((1, 17), 100.0))  # so far away that every motor gives all it has
    paid = 5.0 - humanoids.reward[0]
    assert paid == pytest.approx(0.1 * 17 * 0.4**2, abs=0.05)


def make(num_envs: int, seed: int = 0) -> HumanoidEnv:
    return HumanoidEnv(Locomotion(), num_envs, seed=seed, num_threads=1)


def test_starts_are_upright_and_almost_at_rest() -> None:
    env = make(200)
    observation = env.reset()
    assert observation.shape == (200, 45)
    assert torch.equal(observation, env.state[:, 2:])
    upright = torch.zeros(47)
    upright[2], upright[3] = 1.4, 1.0
    offset = (env.state - upright).abs()
    assert 0.009 < float(offset.max()) <= 0.01 + 1e-4
    assert float(offset.std()) > 0.002
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
    assert env.failed.tolist() == step.terminated.tolist() == [failed, False]
    assert not step.success.any()
    assert (float(step.reward[0]) < 3.0) == failed  # without the bonus for health
    env.reset(step.terminated)
    assert not env.failed.any()
    assert step.terminated.tolist() == [failed, False]  # what was handed out stays
