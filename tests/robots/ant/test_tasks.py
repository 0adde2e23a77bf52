import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np
import pytest
import torch

from astra_data.core.arrays import Floats
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, STATE
from astra_data.robots.ant import tasks
from astra_data.robots.registry import TASKS
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.navigation import Navigation
from astra_data.worlds.simulators import wall_geoms

gymnasium.register_envs(gymnasium_robotics)

SIGNS = np.array([1.0, -1.0, -1.0, 1.0])


def random_state(rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return a level, moving ant of any heading above the ground, its joints inside their limits."""
    qpos, qvel = tasks.ant_model().qpos0.copy(), rng.normal(size=14)
    qpos[2] = 0.8
    half_yaw = rng.uniform(-np.pi, np.pi) / 2
    qpos[3], qpos[6] = np.cos(half_yaw), np.sin(half_yaw)
    qpos[7::2] = rng.uniform(-0.5, 0.5, 4)
    qpos[8::2] = SIGNS * rng.uniform(0.6, 1.2, 4)
    return qpos, qvel


def quarter_turned(qpos: Floats, qvel: Floats) -> tuple[Floats, Floats]:
    """Return the same ant in the same place with its legs numbered one further: body turned by 90 degrees."""
    turned_pos, turned_vel = qpos.copy(), qvel.copy()
    half = np.pi / 4
    mujoco.mju_mulQuat(turned_pos[3:7], qpos[3:7], np.array([np.cos(half), 0, 0, np.sin(half)]))
    turned_vel[3:6] = [qvel[4], -qvel[3], qvel[5]]
    legs = (np.arange(4) + 1) % 4
    turned_pos[7::2], turned_vel[6::2] = qpos[7::2][legs], qvel[6::2][legs]
    for values, turned in ((qpos[8::2], turned_pos[8::2]), (qvel[7::2], turned_vel[7::2])):
        turned[:] = (SIGNS * values)[legs] * SIGNS
    return turned_pos, turned_vel


def feet(qpos: Floats) -> Floats:
    model = tasks.ant_model()
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    names = ("left_ankle_geom", "right_ankle_geom", "third_ankle_geom", "fourth_ankle_geom")
    return np.array([data.geom(name).xpos for name in names])


def test_walls_are_gymnasium_robotics_own() -> None:
    theirs = gymnasium.make("AntMaze_UMaze-v5").unwrapped.ant_env.model  # type: ignore[attr-defined]
    ours = tasks.ant_model(U_MAZE)
    walls = wall_geoms(ours)
    assert walls is not None
    names = {ours.geom(geom).name for geom in range(walls[0], walls[1] + 1)}
    assert names == {theirs.geom(geom).name for geom in range(theirs.ngeom)} - {
        ours.geom(geom).name for geom in range(ours.ngeom) if not walls[0] <= geom <= walls[1]
    }
    assert len(names) == len(U_MAZE.cells(walls=True))
    for name in names:
        for field in ("pos", "size", "type", "contype", "conaffinity", "friction", "solref", "margin"):
            np.testing.assert_array_equal(getattr(ours.geom(name), field), getattr(theirs.geom(name), field))


def test_longer_legs_are_longer_and_nothing_else() -> None:
    plain, longer = tasks.ant_model(U_MAZE), tasks.ant_model(U_MAZE, leg_scale=1.25)
    # Legs are the capsules; a capsule's size is its radius, then half of its length.
    legs = plain.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
    assert legs.sum() == 12
    np.testing.assert_allclose(longer.geom_size[legs, 1], 1.25 * plain.geom_size[legs, 1])
    np.testing.assert_array_equal(longer.geom_size[legs, 0], plain.geom_size[legs, 0])
    np.testing.assert_array_equal(longer.geom_size[~legs], plain.geom_size[~legs])
    np.testing.assert_array_equal(longer.geom_pos[~legs], plain.geom_pos[~legs])
    np.testing.assert_allclose(longer.body_pos[2:], 1.25 * plain.body_pos[2:])
    for name in ("jnt_range", "jnt_axis", "dof_damping", "dof_armature", "actuator_gear", "geom_friction"):
        np.testing.assert_array_equal(getattr(longer, name), getattr(plain, name))
    np.testing.assert_array_equal(longer.qpos0, plain.qpos0)


def test_canonical_view_does_not_see_a_quarter_turn() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        (qpos, qvel), command = random_state(rng), rng.uniform(-1, 1, 2)
        turned_pos, turned_vel = quarter_turned(qpos, qvel)
        # The turned body is the same in space: each foot where the next one was.
        np.testing.assert_allclose(feet(turned_pos), np.roll(feet(qpos), -1, axis=0), atol=1e-12)
        both = np.stack([qpos, turned_pos]), np.stack([qvel, turned_vel])
        observation, quarters = tasks.canonical_view(*both, np.stack([command, command]))
        assert observation.shape == (2, 28)
        np.testing.assert_allclose(observation[0], observation[1], atol=1e-12)
        assert (quarters[0] - quarters[1]) % 4 == 1


def test_the_view_of_an_ant_that_looks_along_its_command_is_read_off() -> None:
    """Rolled by 0.5 rad to the left, in a world frame that is also the heading frame."""
    qpos, qvel = np.zeros((1, 15)), np.arange(1, 15, dtype=np.float64)[None]
    qpos[0, :3], qpos[0, 3:5] = [5.0, -3.0, 0.75], [np.cos(-0.25), np.sin(-0.25)]
    qpos[0, 7:] = [0.1, 1.0, 0.2, -0.9, 0.3, -0.8, 0.4, 0.7]
    observation, quarters = tasks.canonical_view(qpos, qvel, np.array([[0.8, 0.3]]))
    spin = np.zeros(3)
    mujoco.mju_rotVecQuat(spin, qvel[0, 3:6].copy(), qpos[0, 3:7].copy())
    expected = [
        *(0.15, 0.0, np.sin(0.5), np.cos(0.5)),
        *(1.0, 2.0, 3.0, *spin),
        *(0.1, 0.2, 0.3, 0.4, 1.0, 0.9, 0.8, 0.7),
        # A fifth of the joints' rates, those of ankles 2 and 3 the other way round.
        *(1.4, 1.8, 2.2, 2.6, 1.6, -2.0, -2.4, 2.8),
        *(0.8, 0.3),
    ]
    np.testing.assert_allclose(observation[0], expected, atol=1e-12)
    assert quarters.tolist() == [0]


def test_torques_to_body_undoes_the_view() -> None:
    rng = np.random.default_rng(4)  # the same canonical torques move the turned body exactly as the unturned one
    model = tasks.ant_model()
    command = np.array([[1.0, 0.2], [1.0, 0.2]])
    qpos, qvel = model.qpos0.copy(), np.zeros(14)
    qpos[8::2] = SIGNS
    qpos[3], qpos[6] = np.cos(0.4), np.sin(0.4)
    bodies = [(qpos, qvel), quarter_turned(qpos, qvel)]
    data = [mujoco.MjData(model) for _ in bodies]
    for one, (position, velocity) in zip(data, bodies, strict=True):
        one.qpos[:], one.qvel[:] = position, velocity
    for _ in range(10):
        state = np.stack([one.qpos for one in data]), np.stack([one.qvel for one in data])
        _, quarters = tasks.canonical_view(*state, command)
        torques = np.tile(rng.uniform(-1, 1, 8), (2, 1))
        for one, control in zip(data, tasks.torques_to_body(torques, quarters), strict=True):
            one.ctrl[:] = control
            mujoco.mj_step(model, one, 5)
    np.testing.assert_allclose(data[0].qpos[:3], data[1].qpos[:3], atol=1e-9)
    np.testing.assert_allclose(feet(data[1].qpos), np.roll(feet(data[0].qpos), -1, axis=0), atol=1e-9)
    assert np.abs(data[0].qpos[7:] - qpos[7:]).max() > 0.1


@pytest.mark.parametrize("command", [[0.8, 0.0], [0.0, -0.8], [-0.5, 0.5]])
def test_the_shipped_controller_walks_as_told(command: list[float]) -> None:
    controller, model = tasks.VelocityController(), tasks.ant_model()
    data = mujoco.MjData(model)
    data.qpos[8::2] = SIGNS
    mean = np.zeros(2)
    for step in range(100):
        data.ctrl[:] = controller(data.qpos[None], data.qvel[None], np.array([command]))[0]
        mujoco.mj_step(model, data, 5)
        mean += data.qvel[:2] / 60 if step >= 40 else 0.0
    assert np.linalg.norm(mean - command) < 0.25


def test_what_is_dropped_is_the_rest_with_slower_joint_rates() -> None:
    state = torch.arange(29.0).repeat(2, 1)
    rest = tasks.ant_beyond_point_mass(state)
    slowed = [0.2 * entry for entry in range(21, 29)]
    expected = [*range(2, 15), *range(17, 21), *slowed]
    torch.testing.assert_close(rest, torch.tensor([expected, expected]))
    assert torch.equal(state, torch.arange(29.0).repeat(2, 1))  # a copy was scaled


TASK = Navigation(U_MAZE, horizon=700)


def placed(positions: list[list[float]], **options: float) -> tasks.AntMazeEnv:
    """Stand ants at `positions`, with the goal far away."""
    env = tasks.AntMazeEnv(TASK, len(positions), seed=0, num_threads=1, **options)  # type: ignore[arg-type]
    env.reset()
    state = np.tile(tasks.STANDING, (len(positions), 1))
    state[:, :2] = positions
    env.reset_to(np.arange(len(positions)), state)
    return env


def rolled(env: tasks.AntMazeEnv, rows: list[int], angle: float) -> None:
    """Turn `rows` by `angle` about x, well above the ground."""
    state = env.state.numpy().astype(np.float64)[rows]
    state[:, 2], state[:, 3:7] = 2.0, [np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0]
    env.reset_to(np.array(rows), state)


@pytest.mark.parametrize(
    ("degrees", "toppled"),
    [(0.0, False), (76.0, False), (81.0, True), (180.0, True)],  # a cosine of 0.2 is that of 78.5 degrees
)
def test_toppling_is_a_matter_of_the_up_axis(degrees: float, toppled: bool) -> None:
    env = placed([[-4, 4], [-4, 4]])
    rolled(env, [0], np.radians(degrees))
    step = env.step(torch.zeros(2, 2))
    assert env.failed.tolist() == [toppled, False] and step.terminated.tolist() == [toppled, False]
    assert float(step.reward[0]) == pytest.approx(-10.0 * toppled, abs=0.1)
    env.reset(step.terminated)
    assert not env.failed.any()


def test_wall_contact_equals_a_search_through_all_contacts() -> None:
    env = placed([[x, 4.0] for x in (-5.5, -5.0, -4.5, -4.0)], leg_scale=1.25)
    model = tasks.ant_model(U_MAZE, leg_scale=1.25)
    first, last = wall_geoms(model) or (0, 0)
    copies = [mujoco.MjData(model) for _ in range(4)]
    for data, qpos in zip(copies, env.physics.qpos, strict=True):
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
    command = torch.tensor([[-1.0, 0.0]]).expand(4, 2)
    for _ in range(20):
        torques = env.controller(env.physics.qpos, env.physics.qvel, command.double().numpy())
        env.step(command)
        touching = []
        for data, control in zip(copies, torques, strict=True):
            data.ctrl[:] = control
            mujoco.mj_step(model, data, 5)
            pairs = [{int(geom) for geom in contact.geom} for contact in data.contact]
            touching.append(any(first <= geom <= last for pair in pairs for geom in pair))
        assert env.wall_contact.tolist() == touching
    assert env.wall_contact.any()


def test_commands_are_clipped() -> None:
    wild, tame = placed([[-4, 4]]), placed([[-4, 4]])
    for _ in range(3):
        first = wild.step(torch.tensor([[7.0, -3.0]]))
        second = tame.step(torch.tensor([[1.0, -1.0]]))
    assert torch.equal(first.observation[:, :29], second.observation[:, :29])


UMAZE = TASKS["antmaze-umaze"]


def test_states_are_named_as_mujoco_orders_them() -> None:
    model = tasks.ant_model()
    columns = {column.name: column for column in UMAZE.state_columns}
    joints = [model.joint(joint).name for joint in range(1, model.njnt)]
    expected = ("x", "y", "z", "qw", "qx", "qy", "qz", *joints)
    rates = ("vx", "vy", "vz", "wx", "wy", "wz", *(f"{joint}_rate" for joint in joints))
    assert columns[STATE].names == columns[NEXT_STATE].names == (*expected, *rates)
    assert columns[STATE].size == model.nq + model.nv and (columns[GOAL].size, columns[ACTION].size) == (2, 2)
    words = columns[STATE].astra or {}  # MuJoCo tells angular velocities in the body's frame
    assert words["frame"][18:21] == ["body"] * 3 and words["frame"][15:18] == ["world"] * 3
