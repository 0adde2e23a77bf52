import math

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.robots.humanoid.target import (
    COMMANDED,
    CONTACT_M,
    FEET,
    TIMESTEP_S,
    HumanoidEnv,
    Locomotion,
    commanded_angles,
    humanoid_model,
    humanoid_to_walker2d,
)
from astra_data.robots.humanoid.tasks import HumanoidExtendedKinematics, HumanoidWalker2d, sole_clearance, walker_model

# The humanoid's velocities that the walker has: x, z, pitch, and the commanded joints.
SHARED = [0, 2, 4, *(6 + joint for joint in COMMANDED)]


def poses(count: int) -> tuple[Floats, Floats]:
    """Return walkers (count, 7) in the air, and their velocities."""
    rng = np.random.default_rng(0)
    qpos, qvel = rng.uniform(-0.8, 0.0, (count, 7)), rng.normal(size=(count, 7))
    qpos[:, 1] = 2.0
    return qpos, qvel


def humanoid_like(qpos: Floats, qvel: Floats) -> mujoco.MjData:
    """Return the humanoid in the pose of a walker, other joints at zero."""
    model = humanoid_model()
    data = mujoco.MjData(model)
    data.qpos[[0, 2]] = qpos[:2]
    data.qpos[3], data.qpos[5] = np.cos(qpos[2] / 2), np.sin(qpos[2] / 2)
    data.qpos[7 + np.array(COMMANDED)] = qpos[3:]
    data.qvel[SHARED] = qvel
    mujoco.mj_forward(model, data)
    return data


def test_inertia_is_the_humanoids_seen_in_the_plane() -> None:
    walker, humanoid = walker_model(), humanoid_model()
    assert walker.body_mass.sum() == pytest.approx(humanoid.body_mass.sum())
    data = mujoco.MjData(walker)
    for qpos, qvel in zip(*poses(10), strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(walker, data)
        other = humanoid_like(qpos, qvel)
        ours, theirs = np.zeros((7, 7)), np.zeros((23, 23))
        mujoco.mj_fullM(walker, data, ours)
        mujoco.mj_fullM(humanoid, other, theirs)
        np.testing.assert_allclose(ours, theirs[np.ix_(SHARED, SHARED)], atol=1e-6)
        # Gravity, and the forces of the motion itself.
        np.testing.assert_allclose(data.qfrc_bias, other.qfrc_bias[SHARED], atol=1e-6)
        np.testing.assert_allclose(data.qfrc_passive, other.qfrc_passive[SHARED], atol=1e-9)


def test_joints_are_driven_as_the_humanoids() -> None:
    walker, humanoid = walker_model(), humanoid_model()
    data = mujoco.MjData(walker)
    limited = 0
    for qpos, qvel in zip(*poses(10), strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, [0.3, -1.2, -0.8, -0.1]
        mujoco.mj_forward(walker, data)
        other = humanoid_like(qpos, qvel)
        other.ctrl[list(COMMANDED)] = data.ctrl
        mujoco.mj_forward(humanoid, other)
        np.testing.assert_allclose(data.actuator_force, other.actuator_force[list(COMMANDED)], atol=1e-9)
        limited += (np.abs(data.actuator_force) > 79.9).sum()
    assert limited > 0
    for ours, theirs in enumerate(COMMANDED):
        np.testing.assert_array_equal(walker.jnt_range[3 + ours], humanoid.jnt_range[1 + theirs])


def test_soles_touch_where_mujoco_says_so() -> None:
    walker = walker_model()
    data = mujoco.MjData(walker)
    feet = np.flatnonzero(walker.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE)
    rng = np.random.default_rng(1)
    qpos = rng.uniform(-0.4, 0.2, (200, 7))
    qpos[:, 1] = rng.uniform(1.1, 1.35, 200)
    clearance = sole_clearance(torch.from_numpy(qpos[:, 1:]))
    for row in range(200):
        data.qpos[:] = qpos[row]
        mujoco.mj_forward(walker, data)
        bottoms = data.geom_xpos[feet, 2] - walker.geom_size[feet, 0]
        np.testing.assert_allclose(clearance[row], bottoms, atol=1e-12)
        assert (clearance[row] < CONTACT_M).tolist() == [foot in data.contact.geom for foot in feet]
    assert 0.2 < float((clearance < CONTACT_M).double().mean()) < 0.8


def recorded(count: int, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return states, actions and next states of the humanoid under random commands."""
    env = HumanoidEnv(Locomotion(), count, seed=0, num_threads=1)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    rows = []
    for _ in range(steps):
        before, action = env.state, 2 * torch.rand(count, 4, generator=generator) - 1
        env.step(action)
        rows.append((before, action, env.state))
    state, action, next_state = (torch.cat(parts) for parts in zip(*rows, strict=True))
    return state, action, next_state


def test_walking_on_it_equals_mujoco_that_is_not_interrupted() -> None:
    """From poses of the humanoid, whose feet are often lower than the walker's floor was; for 0.9 s."""
    state, _, _ = recorded(6, 20)
    abstract = humanoid_to_walker2d(state[-24:])
    walker = HumanoidWalker2d(24, num_threads=2)
    walker.reset_to(abstract)
    depths = walker.memory[:, 0].tolist()
    assert max(depths) > 0.01 and min(depths) == 0.0
    generator = torch.Generator().manual_seed(0)
    actions = (2 * torch.rand(6, 24, 4, generator=generator) - 1).repeat_interleave(10, 0)
    states = torch.stack([walker.step(action) for action in actions])
    model, apart = walker_model(), []
    feet = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE)
    for row in range(24):
        data = mujoco.MjData(model)
        data.qpos[1:], data.qvel[:] = abstract[row, :6].numpy(), abstract[row, 6:13].numpy()
        mujoco.mj_forward(model, data)
        sunk = max(0.0, -(data.geom_xpos[feet, 2] - model.geom_size[feet, 0]).min())
        assert depths[row] == pytest.approx(sunk, abs=1e-6)
        data.qpos[1] += sunk
        for step, action in enumerate(actions[:, row]):
            data.ctrl[:] = commanded_angles(action.double()).numpy()
            mujoco.mj_step(model, data, 5)
            expected = np.concatenate([data.qpos[1:] - [sunk, *[0.0] * 5], data.qvel])
            if step == 0:
                np.testing.assert_allclose(states[0, row, :13].numpy(), expected, rtol=1e-6, atol=1e-6)
            apart.append(abs(float(states[step, row, 0]) - expected[0]))
    # Rollouts do not hand the solver's last answer on, and states are rounded.
    assert np.quantile(apart, 0.9) < 1e-5 and np.max(apart) < 1e-3


def test_a_correction_says_what_touches_as_the_humanoids_feet_do() -> None:
    """A humanoid that stands touches the floor with feet that are too high for it in the plane."""
    walker = HumanoidWalker2d(3, num_threads=1)
    landed = walker.state.clone()
    landed[:, 0] += torch.tensor([0.0, 0.1, -0.1])
    landed[:, 13:] = torch.tensor([[0.3, -0.2], [1.1, 0.7], [0.49, 0.51]])
    settled = walker.settle(walker.state, landed)
    assert torch.equal(settled[:, :13], landed[:, :13])
    assert settled[:, 13:].tolist() == [[0.0, 0.0], [1.0, 1.0], [0.0, 1.0]] and torch.equal(walker.state, settled)


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
    (mass, feet), (later_mass, later_feet) = (level(state[0, :17].double().numpy()) for state in (before, after))
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
    lean = 0.8 * 0.3 * (1 - slowed)  # leaning forward, its own forward axis points down: up is behind
    expected = torch.tensor([-math.sin(lean), 0.0, math.cos(lean)])
    torch.testing.assert_close(after[40:43], expected, atol=0.01, rtol=0)
