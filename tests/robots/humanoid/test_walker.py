import mujoco
import numpy as np
import pytest
import torch

from astra_data.core.arrays import Floats
from astra_data.robots.humanoid.model import COMMANDED, CONTACT_M, humanoid_model
from astra_data.robots.humanoid.walker2d import sole_clearance, walker_model

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
        touching = [foot in data.contact.geom for foot in feet]
        assert (clearance[row] < CONTACT_M).tolist() == touching
    touched = (clearance < CONTACT_M).double().mean()
    assert 0.2 < float(touched) < 0.8


def test_legs_touch_nothing_but_the_floor() -> None:
    walker = walker_model()
    data = mujoco.MjData(walker)
    low, high = walker.jnt_range[3:].T
    for joints in np.random.default_rng(2).uniform(low, high, (500, 4)):
        data.qpos[:] = [0.0, 3.0, 0.0, *joints]
        mujoco.mj_forward(walker, data)
        assert data.ncon == 0
    data.qpos[1] = 0.3
    mujoco.mj_forward(walker, data)
    assert data.ncon > 0


def test_a_walker_lands_on_its_trunk_too() -> None:
    walker = walker_model()
    data = mujoco.MjData(walker)
    data.qpos[:3] = [0.0, 0.2, np.pi]  # upside down, its legs in the air
    mujoco.mj_forward(walker, data)
    assert data.ncon > 0
    data.qpos[1] = 0.4
    mujoco.mj_forward(walker, data)
    assert data.ncon == 0


def test_floor_and_solver_are_the_humanoids() -> None:
    walker, humanoid = walker_model(), humanoid_model()
    for name in ("timestep", "integrator", "solver", "iterations", "cone", "gravity", "tolerance"):
        np.testing.assert_array_equal(getattr(walker.opt, name), getattr(humanoid.opt, name))
    touches = []
    for model, height in ((walker, 1), (humanoid, 2)):
        data = mujoco.MjData(model)
        data.qpos[height] = 1.28
        mujoco.mj_forward(model, data)
        assert data.ncon == 2
        touches += [data.contact[0], data.contact[1]]
    for touch in touches[:2]:
        for name in ("friction", "dim", "solref", "solimp", "includemargin"):
            np.testing.assert_array_equal(getattr(touch, name), getattr(touches[2], name))
