import mujoco
import numpy as np
import pytest
import torch

from astra_data.core.arrays import Floats
from astra_data.robots.humanoid.target import (
    COMMANDED,
    FEET,
    humanoid_model,
    humanoid_to_extended_kinematics,
    humanoid_to_kinematics,
    humanoid_to_walker2d,
)

MODEL = humanoid_model()
ALL = (humanoid_to_walker2d, humanoid_to_kinematics, humanoid_to_extended_kinematics)


def states(count: int, *, planar: bool = False) -> Floats:
    """Return states (count, 47) of humanoids that lean, turn and move; with `planar`, only in the plane."""
    rng = np.random.default_rng(0)
    state = rng.uniform(-0.5, 0.5, (count, 47))
    state[:, 2] = rng.uniform(0.9, 1.4, count)
    pitch = rng.uniform(-1.2, 1.2, count)
    state[:, 3:7] = rng.normal(size=(count, 4))
    if planar:
        kept = [0, 2, *(7 + joint for joint in COMMANDED), 24, 26, 28, *(30 + joint for joint in COMMANDED)]
        state *= np.isin(np.arange(47), kept)
        state[:, 3], state[:, 5] = np.cos(pitch / 2), np.sin(pitch / 2)
    state[:, 3:7] /= np.linalg.norm(state[:, 3:7], axis=1, keepdims=True)
    return state


def posed_abstraction(state: Floats) -> mujoco.MjData:
    data = mujoco.MjData(MODEL)
    data.qpos[:], data.qvel[:] = state[:24], state[24:]
    mujoco.mj_forward(MODEL, data)
    mujoco.mj_subtreeVel(MODEL, data)
    return data


@pytest.mark.parametrize("abstraction", ALL)
def test_arrays_and_tensors_of_any_shape_give_the_same(abstraction: object) -> None:
    assert callable(abstraction)
    state = states(6)
    abstract = abstraction(state)
    assert abstract.dtype == np.float64
    shaped = torch.from_numpy(state).float().reshape(2, 3, 47)
    torch.testing.assert_close(
        abstraction(shaped).reshape(6, -1).double(), torch.from_numpy(abstract), atol=1e-5, rtol=1e-5
    )
    single = abstraction(state.astype(np.float32)[0])
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, abstract[0], atol=1e-5)


def test_the_pitch_does_not_see_the_heading_and_moves_at_its_rate() -> None:
    step_s = 1e-6
    for state in states(20):
        abstract = humanoid_to_walker2d(state)
        forward = np.zeros(3)
        mujoco.mju_rotVecQuat(forward, np.array([1.0, 0.0, 0.0]), state[3:7])
        assert np.sin(abstract[1]) == pytest.approx(-forward[2], abs=1e-12)
        later = state.copy()
        mujoco.mj_integratePos(MODEL, later[:24], state[24:], step_s)
        moved = humanoid_to_walker2d(later)
        np.testing.assert_allclose((moved[:6] - abstract[:6])[1:] / step_s, abstract[8:13], atol=1e-4)


def test_feet_touch_where_mujoco_says_so() -> None:
    state = states(300)
    # Upright to some degree, so that most feet are near the floor.
    state[:, 3:7] = [1.0, 0.0, 0.0, 0.0] + 0.2 * state[:, 3:7]
    state[:, 3:7] /= np.linalg.norm(state[:, 3:7], axis=1, keepdims=True)
    touched = humanoid_to_walker2d(state)[:, 13:]
    for row, touches in zip(state, touched, strict=True):
        data = posed_abstraction(row)
        floor = MODEL.geom("floor").id
        geoms = {int(geom) for pair in data.contact.geom if floor in pair for geom in pair}
        assert touches.tolist() == [MODEL.geom(foot).id in geoms for foot in FEET]
    assert 0.2 < touched.mean() < 0.8


def test_center_of_mass_and_its_velocity_are_mujocos() -> None:
    state = states(20)
    abstract = humanoid_to_extended_kinematics(state)
    np.testing.assert_array_equal(abstract[:, :34], humanoid_to_kinematics(state))
    for row, ours in zip(state, abstract[:, 34:40], strict=True):
        data = posed_abstraction(row)
        between = np.mean([data.geom(foot).xpos for foot in FEET], axis=0)
        center, forward = data.subtree_com[1], data.body("torso").xmat.reshape(3, 3)[:, 0]
        angle = np.arctan2(forward[1], forward[0])
        # A turn by minus the heading, about the vertical.
        to_heading = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        np.testing.assert_allclose(ours[:2], to_heading @ (center - between)[:2], atol=1e-12)
        np.testing.assert_allclose(ours[2], center[2], atol=1e-12)
        np.testing.assert_allclose(ours[3:5], to_heading @ data.subtree_linvel[1][:2], atol=1e-12)
        np.testing.assert_allclose(ours[5], data.subtree_linvel[1][2], atol=1e-12)


def test_the_lean_of_the_torso_is_told_from_within() -> None:
    state = states(20)
    abstract = humanoid_to_extended_kinematics(state)
    for row, ours in zip(state, abstract[:, 40:], strict=True):
        np.testing.assert_allclose(ours[:3], posed_abstraction(row).body("torso").xmat.reshape(3, 3)[2], atol=1e-12)
        np.testing.assert_array_equal(ours[3:], row[27:30])
