import mujoco
import numpy as np
import pytest

from astra_data.robots.ant.body import ant_model
from astra_data.robots.nao.bodies import BALL_MASS_KG, PITCH_TORQUE_NM, ROLL_TORQUE_NM, SUBSTEPS, nao_model
from astra_data.robots.nao.kicking import BALL_RADIUS_M
from astra_data.robots.nao.kinematics import LEG_JOINTS, TICK_S
from astra_data.worlds.batched_mujoco import wall_geoms
from astra_data.worlds.plane.mazes import U_MAZE


def test_masses_are_the_published_ones() -> None:
    model = nao_model()
    # B-Human's calibration of the V6: torso, neck, head; arms of 93.0 + 157.8 + 64.8 + 77.6 + 185.3 g; legs.
    fixed = 1.0496 + 0.0784 + 0.6594 + 2 * (0.0930 + 0.1578 + 0.0648 + 0.0776 + 0.1853)
    leg = (0.0698, 0.1405, 0.3897, 0.3014, 0.1342, 0.1718)
    assert model.body("Torso").mass[0] == pytest.approx(fixed)
    for side in "LR":
        np.testing.assert_allclose([model.body(side + name).mass[0] for name in LEG_JOINTS], leg)
    assert model.body_mass.sum() == pytest.approx(5.36, abs=0.005)


def test_a_straight_robot_is_as_tall_as_its_links() -> None:
    model = nao_model()
    data = mujoco.MjData(model)
    data.qpos[:] = 0
    data.qpos[3] = 1
    mujoco.mj_forward(model, data)
    for side, sign in (("L", 1), ("R", -1)):
        np.testing.assert_allclose(
            data.body(f"{side}AnkleRoll").xpos, [0, sign * 0.05, -0.085 - 0.1 - 0.1029]
        )
        soles = [data.site(f"{side}Sole{number}").xpos for number in range(4)]
        np.testing.assert_allclose(np.array(soles)[:, 2] - 0.005, -0.085 - 0.1 - 0.1029 - 0.04519)
        # Front left, front right, back left, back right.
        assert soles[0][0] == soles[1][0] > 0 > soles[2][0] == soles[3][0]
        assert soles[0][1] > soles[1][1]
        assert soles[2][1] > soles[3][1]


def test_the_robot_is_its_own_mirror_image() -> None:
    model = nao_model()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.subtree_com[1][1] == pytest.approx(0.0, abs=1e-12)
    for name in LEG_JOINTS:
        left, right = model.joint(f"L{name}"), model.joint(f"R{name}")
        mirrored = -right.range[::-1] if name.endswith("Roll") else right.range
        np.testing.assert_allclose(left.range, mirrored)
    np.testing.assert_allclose(np.degrees(model.joint("LHipYawPitch").range), [-65.62, 42.44])


def test_a_tick_is_a_whole_number_of_physics_steps() -> None:
    assert nao_model().opt.timestep * SUBSTEPS == pytest.approx(TICK_S)


def test_walls_stand_where_the_ants_do() -> None:
    ours, theirs = nao_model(U_MAZE), ant_model(U_MAZE)
    walls = wall_geoms(ours)
    assert walls is not None
    assert walls[1] - walls[0] + 1 == len(U_MAZE.wall_cells())
    for geom in range(walls[0], walls[1] + 1):
        name = ours.geom(geom).name
        np.testing.assert_allclose(ours.geom(name).pos[:2], theirs.geom(name).pos[:2])
        np.testing.assert_allclose(ours.geom(name).size[:2], theirs.geom(name).size[:2])


def test_the_ball_rolls_to_a_stop_at_the_published_rate() -> None:
    model = nao_model(ball=True)
    assert model.body("ball").mass[0] == pytest.approx(BALL_MASS_KG)
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


def test_motors_are_as_strong_as_the_table_has_them() -> None:
    model = nao_model()
    for number in range(model.nu):
        name = model.actuator(number).name
        is_pitch = name[1:] in ("HipPitch", "KneePitch", "AnklePitch")
        torque = PITCH_TORQUE_NM if is_pitch else ROLL_TORQUE_NM
        assert model.actuator_forcerange[number].tolist() == [-torque, torque]
        # Nominal and stall torque of Aldebaran's motors.
        low, high = (1.6, 7.8) if is_pitch else (2.5, 12.0)
        assert low < torque < high


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
