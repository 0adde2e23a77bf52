from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import pytest
from nao_values import IDENTICAL
from numpy.typing import NDArray

from astra_data.core.arrays import Floats
from astra_data.robots.nao import walk as legs
from astra_data.robots.nao.kicking import BALL_RADIUS_M
from astra_data.robots.nao.robot import MOTORS, SUBSTEPS, TICKS, BatchedBodies, BatchedNao, nao_model
from astra_data.worlds.plane.mazes import U_MAZE

LEG = ("HipYawPitch", "HipRoll", "HipPitch", "KneePitch", "AnklePitch", "AnkleRoll")


def test_masses_and_joints_are_the_published_ones() -> None:
    model = nao_model()
    # B-Human's calibration of the V6: torso, neck, head; arms of 93.0 + 157.8 + 64.8 + 77.6 + 185.3 g; legs.
    fixed = 1.0496 + 0.0784 + 0.6594 + 2 * (0.0930 + 0.1578 + 0.0648 + 0.0776 + 0.1853)
    masses = (0.0698, 0.1405, 0.3897, 0.3014, 0.1342, 0.1718)
    assert model.body("Torso").mass[0] == pytest.approx(fixed)
    assert [model.joint(joint).name for joint in range(1, 13)] == [side + name for side in "LR" for name in LEG]
    for side, sign in (("L", 1.0), ("R", -1.0)):
        np.testing.assert_allclose([model.body(side + name).mass[0] for name in LEG], masses)
        for name in LEG[1:]:
            axis = (1, 0, 0) if name.endswith("Roll") else (0, 1, 0)
            np.testing.assert_array_equal(model.joint(side + name).axis, axis)
        hip = model.joint(f"{side}HipYawPitch").axis
        np.testing.assert_allclose(hip, (0.0, 0.5**0.5, -sign * 0.5**0.5))
        roll = model.joint(f"{side}HipRoll").range  # roll angles and the ranges of their joints are mirrored
        np.testing.assert_allclose(np.degrees(np.sort(sign * roll)), (-21.74, 45.29))
    assert model.body_mass.sum() == pytest.approx(5.36, abs=0.005)


def test_the_ball_rolls_to_a_stop_at_the_published_rate() -> None:
    model = nao_model(ball=True)
    assert model.body("ball").mass[0] == pytest.approx(0.045)
    data = mujoco.MjData(model)
    data.qpos[2] = 5.0  # the robot is still falling
    data.qvel[18:21], data.qvel[21:24] = [1.0, 0, 0], [0, 1.0 / BALL_RADIUS_M, 0]
    speeds = []
    for _ in range(round(0.9 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        speeds.append(data.qvel[18])
    middle = np.array(speeds[25:])
    decelerations = -np.diff(middle) / model.opt.timestep
    assert decelerations.mean() == pytest.approx(0.30, abs=0.003)


@pytest.mark.parametrize("part", ["LShank", "RShank", "LFoot", "RFoot", "chest"])
def test_shanks_and_feet_touch_the_ball_and_the_chest_does_not(part: str) -> None:
    model = nao_model(ball=True)
    data = mujoco.MjData(model)
    data.qpos[2] = 1.0
    mujoco.mj_forward(model, data)
    data.qpos[19:22] = data.geom(part).xpos
    mujoco.mj_forward(model, data)
    touched = {model.geom(int(geom)).name for pair in data.contact.geom for geom in pair}
    assert (part in touched) == (part != "chest")


STYLE = replace(legs.STYLE, gyro_gain=(0.0, 0.0))
STANDING = legs.leg_angles(legs.stance(legs.Gait.standing(1)))[0]
FIRST = 3  # the longest delay: so many angles are under way when a control step begins


@pytest.fixture
def stiff(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no ankle push against what the gyroscope measures."""
    monkeypatch.setattr(legs, "STYLE", STYLE)


def bodies(count: int = 1, *, height_m: float = 0.0, **traits: NDArray[Any]) -> BatchedBodies:
    drawn = replace(legs.Traits.draw(IDENTICAL, count, np.random.default_rng(0)), **traits)
    made = BatchedBodies(nao_model(), drawn, longest_delay_ticks=FIRST, num_threads=1)
    qpos = np.tile(made.model.qpos0, (count, 1))
    qpos[:, 2] = STYLE.hip_height_m + legs.HIP_OFFSET_Z_M + height_m
    qpos[:, 7 : 7 + MOTORS] = STANDING[legs.TO_MOTORS]
    made.reset(np.arange(count), qpos, np.tile(STANDING[legs.TO_MOTORS], (count, 1)))
    return made


def targets(count: int = 1, *, carries: tuple[bool, bool] = (False, False), lifts_off: int = 0) -> legs.Targets:
    """Return the standing posture for one control step, changing by 1 mrad per tick."""
    ramp = 1e-3 * np.arange(1, TICKS + 1)[:, None]
    return legs.Targets(
        angles=np.tile(STANDING + ramp, (count, 1, 1)),
        supports=np.tile(np.array(carries), (count, TICKS, 1)),
        lifts_off=np.full((count, TICKS), lifts_off),
        gaits=[],
    )


def noise(count: int = 1) -> Floats:
    return np.zeros((count, TICKS, 3))


@pytest.mark.usefixtures("stiff")
def test_angles_arrive_after_their_delay() -> None:
    robots = bodies(3, delay_ticks=np.array([0, 2, 3]))
    followed = robots.advance(np.arange(3), targets(3), noise(3))
    assert followed.tolist() == [TICKS] * 3
    expected = (STANDING + 1e-3 * np.arange(1, TICKS + 1)[:, None])[:, legs.TO_MOTORS]
    for row in range(3):
        np.testing.assert_allclose(robots.sent[row, FIRST:], expected)
        np.testing.assert_array_equal(robots.sent[row, :FIRST], np.tile(STANDING[legs.TO_MOTORS], (FIRST, 1)))
    controls = robots.state[:, -MOTORS:]  # what the servos held in the last tick is the end of a saved state
    for row, delay in enumerate((0, 2, 3)):
        np.testing.assert_allclose(controls[row], expected[TICKS - 1 - delay])
    robots.advance(np.arange(3), targets(3), noise(3))  # the last ticks of this control step are the first of the next
    np.testing.assert_allclose(robots.sent[:, :FIRST], np.tile(expected[-FIRST:], (3, 1, 1)))


@pytest.mark.usefixtures("stiff")
def test_one_control_step_is_mujocos_own_with_each_robots_floor_and_servos() -> None:
    robots = bodies(2, friction=np.array([0.3, 0.7]), stiffness=np.array([0.8, 1.0]), height_m=0.02)
    before = robots.qpos.copy()
    robots.advance(np.arange(2), targets(2), noise(2))
    for row, (friction, stiffness) in enumerate(((0.3, 0.8), (0.7, 1.0))):
        model = nao_model()
        model.geom("floor").friction[0] = friction
        model.actuator_gainprm[:, 0] = stiffness * 100.0
        model.actuator_biasprm[:, 1] = -stiffness * 100.0
        data = mujoco.MjData(model)
        data.qpos[:] = before[row]
        mujoco.mj_forward(model, data)
        angles = (STANDING + 1e-3 * np.arange(1, TICKS + 1)[:, None])[:, legs.TO_MOTORS]
        for tick in range(TICKS):
            data.ctrl[:] = angles[tick - 2] if tick >= 2 else STANDING[legs.TO_MOTORS]
            mujoco.mj_step(model, data, SUBSTEPS)
        np.testing.assert_allclose(robots.qpos[row], data.qpos, atol=1e-9)
        np.testing.assert_allclose(robots.pressure[row], data.sensordata, atol=1e-6)


def test_the_ankles_that_carry_push_against_the_measured_rates(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the air nothing turns the torso; what the gyroscope measures there is its noise alone."""
    monkeypatch.setattr(legs, "STYLE", replace(STYLE, gyro_gain=(0.1, 0.2), gyro_keep=0.5))
    robots = bodies(height_m=1.0, delay_ticks=np.array([0]))
    measured = noise()
    measured[0, 0] = [0.4, 0.8, 0.0]  # roll and pitch rate in the first tick only
    robots.advance(np.array([0]), targets(carries=(True, False)), measured)
    planned = (STANDING + 1e-3 * np.arange(1, TICKS + 1)[:, None])[:, legs.TO_MOTORS]
    added = robots.sent[0, FIRST:] - planned
    assert added[0, [4, 5]] == pytest.approx([0.1 * 0.4, 0.2 * 0.2], abs=2e-3)
    # Half of a filtered rate lasts to the next tick.
    assert added[1, [4, 5]] == pytest.approx([0.1 * 0.2, 0.2 * 0.1], abs=4e-3)
    assert not added[:, [10, 11]].any() and not np.delete(added, [4, 5, 10, 11], axis=1).any()


@pytest.mark.usefixtures("stiff")
@pytest.mark.parametrize(
    ("lifts_off", "lean_deg", "waits"), [(1, -5, True), (1, 5, False), (-1, 5, True), (-1, -5, False), (0, -5, False)]
)
def test_a_foot_that_the_torso_leans_over_waits_to_be_lifted(lifts_off: int, lean_deg: float, waits: bool) -> None:
    robots = bodies()
    half = np.radians(lean_deg) / 2
    robots.qpos[0, 3:5] = np.cos(half), np.sin(half)  # positive rolls are to the right
    planned = targets()
    planned.lifts_off[:, 0] = lifts_off
    assert (robots.advance(np.array([0]), planned, noise())[0] < TICKS) == waits


@pytest.mark.usefixtures("stiff")
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("degrees", "fallen"), [(44.5, False), (-44.5, False), (46.5, True), (-46.5, True)])
def test_a_robot_that_leans_by_over_45_degrees_any_way_has_fallen(axis: int, degrees: float, fallen: bool) -> None:
    """In the air, where nothing turns it."""
    robots, half = bodies(height_m=1.0), np.radians(degrees) / 2
    robots.qpos[0, 3] = np.cos(half)
    robots.qpos[0, 4 + axis] = np.sin(half)
    robots.advance(np.array([0]), targets(), noise())
    assert bool(robots.fallen[0]) == fallen


@pytest.mark.parametrize(
    "command", [(0.2, 0.0, 0.0), (-0.12, 0.0, 0.0), (0.0, 0.15, 0.0), (0.0, -0.15, 0.0), (0.0, 0.0, 0.8)]
)
def test_it_walks_as_told(command: tuple[float, float, float]) -> None:
    nao = BatchedNao(1, seed=0, spread=IDENTICAL, num_threads=1)
    poses = []
    for _ in range(25):
        nao.step(np.array([command]))
        poses.append(nao.pose[0])
    moved = (np.unwrap(np.array(poses), axis=0)[-1] - np.array(poses)[10]) / (14 * 0.192)
    if command[2]:
        assert moved[2] == pytest.approx(command[2], rel=0.3)
    else:
        np.testing.assert_allclose(moved[:2], command[:2], atol=0.3 * max(np.abs(command)))
    assert not nao.bodies.fallen.any()


def turned(*roll_pitch_yaw: float) -> Floats:
    """Return the quaternion of Rz(yaw) Ry(pitch) Rx(roll)."""
    quaternion = np.zeros(4)
    mujoco.mju_euler2Quat(quaternion, np.array(roll_pitch_yaw), "XYZ")
    return quaternion


def test_a_lean_to_the_right_and_one_ahead_are_positive_and_tilts_see_no_heading() -> None:
    nao = BatchedNao(3, seed=0, num_threads=1)
    nao.bodies.qpos[:, 3:7] = [turned(0.1, 0.0, 0.0), turned(0.0, 0.2, 0.0), turned(-0.3, 0.2, 2.5)]
    np.testing.assert_allclose(nao.tilt, [[0.1, 0.0], [0.0, 0.2], [-0.3, 0.2]], atol=1e-12)
    np.testing.assert_allclose(nao.pose[:, 2], [0.0, 0.0, 2.5], atol=1e-12)


def test_walls_are_felt_and_stop_it() -> None:
    # The wall's face is at x = -6; the robot's toes are 0.1 m ahead of it.
    nao = BatchedNao(2, seed=0, maze=U_MAZE, spread=IDENTICAL, num_threads=1)
    nao.reset(np.arange(2), np.array([[-5.7, 4.0, np.pi], [-4.0, 4.0, np.pi]]), np.random.default_rng(0))
    felt = np.zeros(2, dtype=bool)
    for _ in range(15):
        nao.step(np.tile([0.2, 0.0, 0.0], (2, 1)))
        felt |= nao.bodies.touching
    assert felt.tolist() == [True, False] and nao.pose[0, 0] > -5.95


def test_a_fallen_robot_is_told_and_stays_until_its_reset() -> None:
    nao = BatchedNao(2, seed=0, num_threads=1)
    half = np.radians(30)
    nao.bodies.qpos[0, 3:7] = [np.cos(half), 0.0, np.sin(half), 0.0]
    nao.step(np.zeros((2, 3)))
    assert nao.bodies.fallen.tolist() == [True, False]
    lying = nao.bodies.state[0].copy()
    nao.step(np.full((2, 3), 0.1))
    np.testing.assert_array_equal(nao.bodies.state[0], lying)
    assert nao.arrays()["noise"].tolist() == [0, 2]  # each step's is another
    nao.reset(np.array([0]), np.zeros((1, 3)), np.random.default_rng(0))
    assert not nao.bodies.fallen.any()


@pytest.mark.parametrize("side", [1, -1])
def test_balls_are_kicked_by_the_foot_on_their_side_wherever_the_robot_looks(side: int) -> None:
    yaw = np.array([0.0, 1.5, 3.0, -1.5])
    nao = BatchedNao(4, seed=0, ball=True, spread=IDENTICAL, num_threads=1)
    ball = np.exp(1j * yaw) * (0.3 + 0.06j * side)
    nao.reset(
        np.arange(4),
        np.column_stack([np.zeros((4, 2)), yaw]),
        np.random.default_rng(0),
        np.column_stack([ball.real, ball.imag]),
    )
    kicked = np.zeros(4, dtype=bool)
    for _ in range(8):
        nao.step(np.zeros((4, 3)), kick=np.ones(4, dtype=bool))
        gait = nao.gait
        kicked |= gait.kicking
        assert (gait.left_swings[gait.kicking] == (side > 0)).all()
    assert kicked.all()
