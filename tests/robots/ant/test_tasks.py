import mujoco
import numpy as np
import pytest
import torch

from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, STATE
from astra_data.robots.ant.body import ant_model, standing_pose
from astra_data.robots.ant.tasks import AntMazeEnv, ant_beyond_point_mass, ant_to_point_mass
from astra_data.robots.registry import TASKS
from astra_data.worlds.batched_mujoco import wall_geoms
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.navigation import Navigation


def test_keeps_planar_position_and_velocity() -> None:
    state = np.arange(2 * 3 * 29, dtype=np.float32).reshape(2, 3, 29)
    abstract = ant_to_point_mass(state)
    assert abstract.shape == (2, 3, 4)
    assert abstract.dtype == np.float32
    np.testing.assert_array_equal(abstract[..., :2], state[..., :2])  # x, y open qpos
    np.testing.assert_array_equal(abstract[..., 2:], state[..., 15:17])  # vx, vy open qvel
    assert torch.equal(ant_to_point_mass(torch.from_numpy(state)), torch.from_numpy(abstract))


def test_what_is_dropped_is_the_rest_with_slower_joint_rates() -> None:
    state = torch.arange(29.0).repeat(2, 1)
    rest = ant_beyond_point_mass(state)
    slowed = [0.2 * entry for entry in range(21, 29)]
    expected = [*range(2, 15), *range(17, 21), *slowed]
    torch.testing.assert_close(rest, torch.tensor([expected, expected]))
    assert torch.equal(state, torch.arange(29.0).repeat(2, 1))  # a copy was scaled


TASK = Navigation(U_MAZE, horizon=700)


def placed(positions: list[list[float]], **options: float) -> AntMazeEnv:
    """Stand ants at `positions`, with the goal far away."""
    env = AntMazeEnv(TASK, len(positions), seed=0, num_threads=1, **options)  # type: ignore[arg-type]
    env.reset()
    state = np.concatenate([standing_pose(len(positions)), np.zeros((len(positions), 14))], axis=1)
    state[:, :2] = positions
    env.reset_to(np.arange(len(positions)), state)
    return env


def rolled(env: AntMazeEnv, rows: list[int], angle: float) -> None:
    """Turn `rows` by `angle` about x, well above the ground."""
    state = env.state.numpy().astype(np.float64)[rows]
    state[:, 2], state[:, 3:7] = 2.0, [np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0]
    env.reset_to(np.array(rows), state)


@pytest.mark.parametrize(
    ("degrees", "toppled"),
    # A cosine of 0.2 is that of 78.5 degrees.
    [(0.0, False), (60.0, False), (76.0, False), (81.0, True), (100.0, True), (180.0, True)],
)
def test_toppling_is_a_matter_of_the_up_axis(degrees: float, toppled: bool) -> None:
    env = placed([[-4, 4], [-4, 4]])
    rolled(env, [0], np.radians(degrees))
    step = env.step(torch.zeros(2, 2))
    assert env.failed.tolist() == [toppled, False]
    assert step.terminated.tolist() == [toppled, False]
    assert float(step.reward[0]) == pytest.approx(-10.0 * toppled, abs=0.1)
    env.reset(step.terminated)
    assert not env.failed.any()


def test_walls_are_felt_and_the_floor_is_not() -> None:
    # The walls' faces are at y = 6 and x = -6, and feet stand 0.6 m to the sides.
    env = placed([[-4.0, 5.45], [-5.45, 4.0], [-4.0, 4.0], [0.0, 4.0]])
    felt = torch.zeros(4, dtype=torch.bool)
    for _ in range(6):
        env.step(torch.zeros(4, 2))
        felt |= env.wall_contact
    assert felt.tolist() == [True, True, False, False]


def test_wall_contact_equals_a_search_through_all_contacts() -> None:
    env = placed([[x, 4.0] for x in (-5.5, -5.0, -4.5, -4.0)], leg_scale=1.25)
    model = ant_model(U_MAZE, leg_scale=1.25)
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
    model = ant_model()
    columns = {column.name: column for column in UMAZE.state_columns}
    joints = [model.joint(joint).name for joint in range(1, model.njnt)]
    expected = ("x", "y", "z", "qw", "qx", "qy", "qz", *joints)
    rates = ("vx", "vy", "vz", "wx", "wy", "wz", *(f"{joint}_rate" for joint in joints))
    assert columns[STATE].names == columns[NEXT_STATE].names == (*expected, *rates)
    assert columns[STATE].size == model.nq + model.nv
    assert (columns[GOAL].size, columns[ACTION].size) == (2, 2)
    data = mujoco.MjData(model)
    data.qvel[3:6] = [0.0, 0.0, 1.0]
    data.qpos[3:7] = [0.5**0.5, 0.5**0.5, 0.0, 0.0]  # rolled by 90 degrees: its z axis points along -y
    mujoco.mj_forward(model, data)
    world = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, 1, world, 0)
    np.testing.assert_allclose(world[:3], [0.0, -1.0, 0.0], atol=1e-12)
    # So the angular velocity is told in the body's frame, as the column says.
    words = columns[STATE].astra or {}
    assert words["frame"][18:21] == ["body"] * 3 and words["frame"][15:18] == ["world"] * 3
