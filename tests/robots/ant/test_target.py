from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from astra_data.robots.ant.body import VelocityController, ant_model, standing_pose
from astra_data.robots.ant.tasks import AntMazeEnv
from astra_data.worlds.batched_mujoco import wall_geoms
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.navigation import Navigation

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


def test_a_saved_state_goes_on_alike() -> None:
    env = AntMazeEnv(TASK, 2, seed=0, num_threads=1)
    env.reset()
    saved = env.state_dict()
    observations = [env.step(torch.full((2, 2), 0.5)).observation]
    for _ in range(2):
        env.reset()  # with another goal, too
        env.load_state_dict(saved)
        observations.append(env.step(torch.full((2, 2), 0.5)).observation)
    assert torch.equal(observations[0], observations[1])
    assert torch.equal(observations[0], observations[2])


def test_walls_are_felt_and_the_floor_is_not() -> None:
    # The walls' faces are at y = 6 and x = -6, and feet stand 0.6 m to the sides.
    env = placed([[-4.0, 5.45], [-5.45, 4.0], [-4.0, 4.0], [0.0, 4.0]])
    felt = torch.zeros(4, dtype=torch.bool)
    for _ in range(6):
        env.step(torch.zeros(4, 2))
        felt |= env.wall_contact
    assert felt.tolist() == [True, True, False, False]


def test_wall_contacts_handed_out_stay() -> None:
    env = placed([[-4.0, 4.0]])
    handed_out = env.wall_contact
    env.physics.touching[:] = True
    assert env.wall_contact.all() and not handed_out.any()


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


def test_ants_follow_the_controller_that_they_are_given() -> None:
    limp = VelocityController([(torch.zeros(8, 28), torch.ones(8))], torque_scale=0.0)
    env = AntMazeEnv(TASK, 1, seed=0, controller=limp, num_threads=1)
    env.reset()
    model = ant_model(U_MAZE)
    data = mujoco.MjData(model)
    data.qpos[:] = env.physics.qpos[0]
    mujoco.mj_forward(model, data)
    for _ in range(10):
        env.step(torch.ones(1, 2))
        mujoco.mj_step(model, data, 5)
    np.testing.assert_allclose(env.physics.qpos[0], data.qpos, atol=1e-9)


def test_starts_goals_and_headings() -> None:
    env = AntMazeEnv(TASK, 400, seed=0, num_threads=2)
    observation = env.reset().double()
    assert observation.shape == (400, 31)
    for points, cell in ((observation[:, :2], U_MAZE.start), (observation[:, 29:], U_MAZE.goal)):
        offset = points - torch.tensor(U_MAZE.cell_center(*cell))
        assert float(offset.mean()) == pytest.approx(0.0, abs=0.03)
        assert float(offset.std()) == pytest.approx(0.2, abs=0.02)
    yaw = 2 * torch.atan2(observation[:, 6], observation[:, 3])
    assert torch.allclose(yaw.cos().mean(), torch.tensor(0.0).double(), atol=0.12)
    assert torch.allclose(yaw.sin().mean(), torch.tensor(0.0).double(), atol=0.12)
    assert bool((observation[:, 15:29] == 0).all())


def test_starts_anywhere_leave_the_start_cell() -> None:
    env = AntMazeEnv(TASK, 50, seed=0, start_anywhere=True, num_threads=1)
    position = env.reset()[:, :2].numpy()
    assert (np.linalg.norm(position - U_MAZE.cell_center(*U_MAZE.start), axis=1) > 2).mean() > 0.5


def test_success_ends_the_episode() -> None:
    env = placed([[-4, 4], [-4, 4]])
    env.goal = torch.tensor([[-4.0, 4.0], [-4.0, -4.0]])
    step = env.step(torch.zeros(2, 2))
    assert step.success.tolist() == step.terminated.tolist() == [True, False]
    assert float(step.reward[0]) > 9.0


@pytest.mark.parametrize("ends", [False, True])
def test_touching_a_wall_fails_where_that_is_asked(ends: bool) -> None:
    """One stands at a wall, one in the open; who reaches the goal in the same step has not failed."""
    env, touches, fails = placed([[-4.0, 5.45], [-4.0, 4.0]]), 0, 0
    env.objective = replace(TASK, ends_at_walls=ends)
    for _ in range(6):
        step = env.step(torch.zeros(2, 2))
        touches += int(env.wall_contact[0])
        fails += int(env.failed[0])
        assert not env.wall_contact[1] and not env.failed[1]
        assert torch.equal(step.terminated, env.failed)
    assert touches > 0 and fails == ends * touches
    for _ in range(6):
        env.goal[0] = env.position[0]
        step = env.step(torch.zeros(2, 2))
        assert step.success[0] and not env.failed[0]


def test_zero_command_stands_still() -> None:
    env = placed([[-4, 4], [0, 4]])
    start = env.state[:, :2]
    for _ in range(60):
        env.step(torch.zeros(2, 2))
    assert float((env.state[:, :2] - start).norm(dim=1).max()) < 0.5
    assert not env.failed.any()
    speeds = []
    for _ in range(20):
        env.step(torch.zeros(2, 2))
        speeds.append(env.state[:, 15:17].norm(dim=1))
    assert float(torch.stack(speeds).mean()) < 0.15


def test_the_reach_covers_every_leg() -> None:
    # The farthest that any geom's surface is from the torso's center, legs stretched.
    def farthest(leg_scale: float) -> float:
        model = ant_model(leg_scale=leg_scale)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        torso = data.body("torso").xpos
        ends = []
        for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE):
            axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
            center = data.geom_xpos[geom] - torso
            ends += [np.linalg.norm(center + sign * axis) + model.geom_size[geom, 0] for sign in (1, -1)]
        return float(max(ends))

    assert farthest(1.0) < 1.6
    assert farthest(1.25) < 1.6 * 1.25


def test_who_topples_at_the_goal_has_reached_it() -> None:
    env = placed([[-4, 4], [-4, 4]])
    rolled(env, [0, 1], np.pi)
    env.goal = env.position + torch.tensor([[0.0, 0.0], [3.0, 0.0]])
    step = env.step(torch.zeros(2, 2))
    assert step.success.tolist() == [True, False] and env.failed.tolist() == [False, True]
    assert step.terminated.tolist() == [True, True]
    assert step.reward.tolist() == pytest.approx([10.0, -10.0], abs=0.2)
