import math
from typing import Any

import mujoco
import pytest
import torch
from torch import Tensor

from astra_data.robots.humanoid.kinematics import HumanoidExtendedKinematics, HumanoidKinematics
from astra_data.robots.humanoid.model import COMMANDED, CommandRanges, Locomotion
from astra_data.robots.humanoid.target import HumanoidEnv
from astra_data.robots.humanoid.tasks import VariedHumanoid
from astra_data.robots.humanoid.walker2d import HumanoidWalker2d, walker_model
from astra_data.worlds.variation import JointVariation, VariedSimulator

KINDS = (HumanoidWalker2d, HumanoidKinematics, HumanoidExtendedKinematics)
Kind = type[HumanoidWalker2d] | type[HumanoidKinematics]
WIDE = JointVariation(
    friction=(0.2, 3.0),
    action_scale=(-0.5, 0.5),
    action_noise=(0.1, 0.2),
    observation_scale=(0.5, 2.0),
    timestep_scale=(0.5, 1.7),
)
ACTION = torch.tensor([[-0.5, -0.2, 0.4, 0.1]])


def moving(kind: Kind, count: int) -> Tensor:
    """Return states (count, X) of humanoids under random commands."""
    env = HumanoidEnv(Locomotion(), count, seed=0, num_threads=1)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        env.step(2 * torch.rand(count, 4, generator=generator) - 1)
    return kind.abstraction(env.state)


def varied(kind: Kind, state: Tensor, variation: JointVariation) -> VariedHumanoid:
    simulator = VariedHumanoid(kind(len(state)), variation)
    simulator.reset_to(state)
    return simulator


def plain(kind: Kind, state: Tensor) -> Any:  # noqa: ANN401 - whichever kind
    simulator = kind(len(state))
    simulator.reset_to(state)
    return simulator


@pytest.mark.parametrize("kind", KINDS)
def test_plain_parameters_are_the_plain_simulator(kind: Kind) -> None:
    torch.manual_seed(0)
    state = moving(kind, 6)
    ours, theirs = varied(kind, state, JointVariation()), plain(kind, state)
    assert isinstance(ours, VariedSimulator)
    for _ in range(20):
        action = torch.randn(6, 4)
        assert torch.equal(ours.step(action), theirs.step(action))
    assert torch.equal(ours.state, ours.true_state)
    rows = torch.tensor([1, 4])
    for simulator in (ours, theirs):
        simulator.reset_to(state[:2], rows)
    assert torch.equal(ours.state, theirs.state)
    assert not ours.blocked.any()
    landed = ours.state + 0.01
    assert torch.equal(ours.settle(ours.state, landed), theirs.settle(theirs.state, landed))


@pytest.mark.parametrize("kind", KINDS)
def test_rows_have_their_own_parameters_and_seeds_repeat_them(kind: Kind) -> None:
    state = moving(kind, 5)
    torch.manual_seed(3)
    together = varied(kind, state, WIDE)
    torch.manual_seed(4)
    after = together.step(ACTION.expand(5, 4))
    torch.manual_seed(4)
    noise = torch.randn(5, 4)
    parameters = together.parameters
    for row in range(5):
        alone = varied(kind, state[row : row + 1], WIDE)
        alone.parameters = parameters[row : row + 1].clone()
        alone.parameters[:, WIDE.names.index("action_noise")] = 0.0
        strength = together.by_name()["action_noise"][row]
        landed = alone.step(ACTION + strength * noise[row])
        torch.testing.assert_close(landed[0], after[row], atol=1e-5, rtol=1e-5)
    torch.manual_seed(3)
    again = varied(kind, state, WIDE)
    torch.manual_seed(4)
    assert torch.equal(again.step(ACTION.expand(5, 4)), after)
    # As plain as ever, once the parameters are.
    together.parameters = JointVariation().draw(5)
    together.true_state = state
    assert torch.equal(together.step(ACTION.expand(5, 4)), plain(kind, state).step(ACTION.expand(5, 4)))


@pytest.mark.parametrize("kind", KINDS)
def test_commands_are_scaled_as_far_as_there_is_room(kind: Kind) -> None:
    state = moving(kind, 2)
    longer = varied(kind, state, JointVariation(action_scale=(0.5, 0.5)))
    command = torch.tensor([[-0.4, 0.2, 0.6, 0.9], [5.0, -5.0, 0.0, 0.0]])
    expected = torch.tensor([[-0.6, 0.3, 0.9, 1.0], [1.0, -1.0, 0.0, 0.0]])
    torch.testing.assert_close(longer.step(command), plain(kind, state).step(expected), atol=1e-5, rtol=1e-5)
    # Cut off first, a command out of reach is not what it was either.
    shorter = varied(kind, state, JointVariation(action_scale=(-0.5, -0.5)))
    expected = torch.tensor([[-0.2, 0.1, 0.3, 0.45], [0.5, -0.5, 0.0, 0.0]])
    torch.testing.assert_close(shorter.step(command), plain(kind, state).step(expected), atol=1e-5, rtol=1e-5)


def test_noise_on_commands_moves_the_joints() -> None:
    torch.manual_seed(0)
    state = torch.zeros(20_000, 34)
    noisy = varied(HumanoidKinematics, state, JointVariation(action_noise=(0.1, 0.1)))
    angles = noisy.step(ACTION.expand(20_000, 4))[:, COMMANDED]
    assert torch.equal(noisy.state, noisy.true_state)
    ranges = CommandRanges()
    half = math.radians((ranges.hip_deg[1] - ranges.hip_deg[0]) / 2)
    reached = 1 - math.exp(-200 / 15 * 0.015)
    assert float(angles[:, 0].std()) == pytest.approx(0.1 * half * reached, rel=0.02)
    expected = ranges.targets(ACTION[0])[0] * reached
    assert float(angles[:, 0].mean()) == pytest.approx(float(expected), abs=2e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_shown_is_scaled_and_what_is_so_is_not(kind: Kind) -> None:
    state = moving(kind, 3)
    ours = varied(kind, state, JointVariation(observation_scale=(1.1, 1.1)))
    theirs = plain(kind, state)
    assert torch.equal(ours.state, 1.1 * state)
    for _ in range(5):
        shown = ours.step(ACTION.expand(3, 4))
        assert torch.equal(ours.true_state, theirs.step(ACTION.expand(3, 4)))
        assert torch.equal(shown, 1.1 * ours.true_state)
    # What is corrected is what is shown.
    landed = shown.clone()
    landed[:, 0] += 0.11
    settled = ours.settle(shown, landed)
    torch.testing.assert_close(settled[:, :13], landed[:, :13], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(ours.true_state[:, 0], theirs.state[:, 0] + 0.1, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_friction_and_timestep_change_how_far_joints_get(kind: Kind) -> None:
    state = kind(1).state.repeat(2, 1)
    simulator = varied(kind, state, JointVariation(friction=(2.0, 2.0), timestep_scale=(1.5, 1.5)))
    landed = simulator.step(ACTION.expand(2, 4))[0]
    targets = CommandRanges().targets(ACTION[0]).tolist()
    for joint, target, damping in zip(COMMANDED, targets, [5.0, 1.0, 5.0, 1.0], strict=True):
        rate = 200 / (10 + 2 * damping)
        left = math.exp(-rate * 1.5 * 0.015)
        assert float(landed[joint]) == pytest.approx(target * (1 - left), abs=1e-5)
        assert float(landed[17 + joint]) == pytest.approx(target * rate * left, abs=1e-4)


def test_a_longer_step_slows_the_body_and_moves_it_for_longer() -> None:
    state = HumanoidExtendedKinematics(2).state.clone()
    state[:, 34:40] = torch.tensor([0.2, 0.0, 0.9, 0.5, -0.1, -0.4])
    # Joints that are where commands want them leave all to the velocity.
    state[:, COMMANDED] = CommandRanges().targets(torch.zeros(4))
    simulator = varied(HumanoidExtendedKinematics, state, JointVariation(timestep_scale=(2.0, 2.0)))
    after = simulator.step(torch.zeros(2, 4))[0]
    slowed = math.exp(-0.03 / 0.3)
    torch.testing.assert_close(after[37:40], slowed * state[0, 37:40], atol=1e-5, rtol=0)
    assert float(after[36]) == pytest.approx(0.9 - 0.4 * slowed * 0.03, abs=1e-5)


def test_walkers_have_the_damping_and_the_time_that_they_were_given() -> None:
    state = moving(HumanoidWalker2d, 3)
    state[:, 0] += 0.2  # off the floor
    simulator = varied(HumanoidWalker2d, state, JointVariation())
    friction, scale = [0.5, 1.0, 2.0], [1.0, 1.5, 0.8]
    simulator.parameters = simulator.parameters.clone()
    for name, values in (("friction", friction), ("timestep_scale", scale)):
        simulator.parameters[:, simulator.variation.names.index(name)] = torch.tensor(values)
    after = simulator.step(ACTION.expand(3, 4))
    for row in range(3):
        model = walker_model()
        model.dof_damping[3:] *= friction[row]
        model.opt.timestep *= simulator.parameters[row, simulator.variation.names.index("timestep_scale")]
        data = mujoco.MjData(model)
        data.qpos[1:], data.qvel[:] = state[row, :6].numpy(), state[row, 6:13].numpy()
        data.ctrl[:] = CommandRanges().targets(ACTION[0].double()).numpy()
        mujoco.mj_step(model, data, 5)
        assert data.time == pytest.approx(0.015 * scale[row])
        landed = torch.tensor([*data.qpos[1:], *data.qvel]).float()
        torch.testing.assert_close(after[row, :13], landed, atol=1e-5, rtol=1e-5)
