import numpy as np
import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.robots.humanoid.model import CommandRanges, Locomotion
from astra_data.robots.humanoid.target import HumanoidEnv, Humanoids


def make(num_envs: int, seed: int = 0, ranges: CommandRanges | None = None) -> HumanoidEnv:
    return HumanoidEnv(Locomotion(), num_envs, seed=seed, ranges=ranges, num_threads=1)


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


def test_there_is_neither_goal_nor_wall() -> None:
    env = make(2)
    env.reset(torch.tensor([False, True]))
    assert env.goal.shape == (2, 0)
    env.step(torch.zeros(2, 4))
    assert env.wall_contact.tolist() == [False, False]


def test_what_is_not_for_a_humanoid_is_refused() -> None:
    with pytest.raises(BadInputError, match="start: expected 'task' for a humanoid, got 'anywhere'"):
        HumanoidEnv(Locomotion(), 1, seed=0, start_anywhere=True)


def test_commands_are_clipped() -> None:
    wild, tame = make(1), make(1)
    first = wild.step(torch.tensor([[7.0, -3.0, 2.0, -1.5]]))
    second = tame.step(torch.tensor([[1.0, -1.0, 1.0, -1.0]]))
    assert torch.equal(first.observation, second.observation)


def test_ranges_are_options() -> None:
    narrow = make(1, ranges=CommandRanges(hip_deg=(-10.0, 10.0), knee_deg=(-20.0, -10.0)))
    bodies = Humanoids(Locomotion(), 1, num_threads=1)
    target = np.zeros((1, 17))
    target[0, [9, 10, 5, 6]] = np.radians([10.0, -15.0, 0.0, -20.0])
    narrow.step(torch.tensor([[1.0, 0.0, 0.0, -1.0]]))
    bodies.step(target)
    np.testing.assert_allclose(narrow.bodies.state, bodies.state, atol=1e-12)


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


def test_a_saved_state_goes_on_alike() -> None:
    env = make(2)
    env.reset()
    env.step(torch.zeros(2, 4))
    saved = env.state_dict()
    first = env.step(torch.full((2, 4), 0.5))
    env.reset()
    env.load_state_dict(saved)
    second = env.step(torch.full((2, 4), 0.5))
    assert torch.equal(first.observation, second.observation)
    assert torch.equal(first.reward, second.reward)


def test_random_commands_fell_it_as_measured() -> None:
    # 64 of them fell after 50 to 81 steps, 65 in the mean.
    env = make(24)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    steps, active = torch.zeros(24), torch.ones(24, dtype=torch.bool)
    for _ in range(130):
        steps += active
        active &= ~env.step(2 * torch.rand(24, 4, generator=generator) - 1, active).terminated
    assert not active.any()
    assert float(steps.mean()) == pytest.approx(65.0, abs=7.0)
    assert float(steps.min()) > 40
