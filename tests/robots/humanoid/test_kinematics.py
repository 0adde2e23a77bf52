import math

import mujoco
import numpy as np
import pytest
import torch

from astra_data.core.arrays import Floats
from astra_data.robots.humanoid.kinematics import HumanoidExtendedKinematics, HumanoidKinematics
from astra_data.robots.humanoid.model import (
    COMMANDED,
    FEET,
    TIMESTEP_S,
    CommandRanges,
    humanoid_model,
)

KINDS = (HumanoidKinematics, HumanoidExtendedKinematics)
Kind = type[HumanoidKinematics]


@pytest.mark.parametrize("kind", KINDS)
def test_joints_approach_their_targets(kind: Kind) -> None:
    simulator = kind(1)
    action = torch.tensor([[-0.5, -0.2, 0.7, 9.0]])
    for _ in range(7):
        state = simulator.step(action)[0]
    targets = CommandRanges().targets(action[0])
    time_s = 7 * 0.015
    # Gains 200 and 10; hips are damped by 5, knees by 1.
    for joint, target, damping in zip(COMMANDED, targets.tolist(), [5.0, 1.0, 5.0, 1.0], strict=True):
        rate = 200 / (10 + damping)
        left = math.exp(-rate * time_s)
        assert float(state[joint]) == pytest.approx(target * (1 - left), abs=1e-5)
        assert float(state[17 + joint]) == pytest.approx(target * rate * left, abs=1e-4)
    others = [joint for joint in range(17) if joint not in COMMANDED]
    assert not state[others].any()


def level(angles: Floats) -> tuple[Floats, Floats]:
    """Return MuJoCo's center of mass (3,) and feet (2, 3) of a humanoid whose torso is at the origin."""
    model = humanoid_model()
    data = mujoco.MjData(model)
    data.qpos[:3], data.qpos[7:] = 0.0, angles
    mujoco.mj_forward(model, data)
    return data.subtree_com[1].copy(), np.array([data.geom(foot).xpos for foot in FEET])


@pytest.mark.parametrize("bent", [5, 9])  # the right or the left hip, so that the other foot is lower
def test_the_center_of_mass_moves_as_if_the_lower_foot_stood(bent: int) -> None:
    simulator = HumanoidExtendedKinematics(1, follow_s=1e-6)
    before = simulator.state.clone()
    before[0, bent] = -0.4
    simulator.reset_to(before)
    after = simulator.step(torch.tensor([[0.1, -0.5, 0.3, 0.2]]))
    (mass, feet), (later_mass, later_feet) = (
        level(state[0, :17].double().numpy()) for state in (before, after)
    )
    foot = {5: 0, 9: 1}[bent]
    assert feet[foot, 2] < feet[1 - foot, 2] - 0.01
    way = (later_mass - later_feet[foot]) - (mass - feet[foot])
    np.testing.assert_allclose(after[0, 37:40], way / TIMESTEP_S, atol=1e-4)
    moved = (after - before)[0, 34:37].numpy()
    assert moved[2] == pytest.approx(way[2], abs=1e-6)
    aside = (later_mass - later_feet.mean(axis=0)) - (mass - feet.mean(axis=0))
    np.testing.assert_allclose(moved[:2], aside[:2], atol=1e-6)
    assert np.abs(way[[0, 2]]).min() > 1e-3


def test_the_torso_turns_on_and_ever_slower() -> None:
    simulator = HumanoidExtendedKinematics(1, follow_s=0.3)
    state = simulator.state.clone()
    assert state[0, 40:].tolist() == [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    spin = torch.tensor([0.0, 0.8, 0.0])
    state[0, 43:] = spin
    simulator.reset_to(state)
    for _ in range(20):
        after = simulator.step(torch.zeros(1, 4))[0]
    slowed = math.exp(-20 * 0.015 / 0.3)
    torch.testing.assert_close(after[43:], slowed * spin, atol=1e-5, rtol=0)
    # Leaning forward, its own forward axis points down: up is behind.
    lean = 0.8 * 0.3 * (1 - slowed)
    expected = torch.tensor([-math.sin(lean), 0.0, math.cos(lean)])
    torch.testing.assert_close(after[40:43], expected, atol=0.01, rtol=0)
