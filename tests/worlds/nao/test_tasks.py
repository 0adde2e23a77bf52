import numpy as np
import pytest
import torch
from nao_values import NO_ERRORS

from astra_data.dataset.columns import ACTION, GOAL, STATE
from astra_data.worlds.nao.kinematics import JOINTS, foot_poses
from astra_data.worlds.nao.target import NaoEnv
from astra_data.worlds.nao.tasks import KICK_RANGES, NAO_TASKS
from astra_data.worlds.nao.traits import IDENTICAL
from astra_data.worlds.plane.mazes import FIELD, S_MAZE
from astra_data.worlds.registry import TASKS
from astra_data.worlds.variation import WIDE_RANGES

NAVIGATION, KICK = NAO_TASKS


def columns(name: str) -> dict[str, object]:
    return {column.name: column for column in TASKS[name].state_columns}


def test_navigation_and_kicking() -> None:
    assert [task.name for task in NAO_TASKS] == ["nao-navigation", "nao-kick"]
    assert (NAVIGATION.maze, KICK.maze) == (S_MAZE, FIELD)
    assert NAVIGATION.timestep_s == KICK.timestep_s == pytest.approx(0.192)
    assert KICK.objective.horizon * KICK.timestep_s == pytest.approx(30.0, abs=0.1)
    assert {task.facts["stand_in"] for task in NAO_TASKS} == {"mujoco"}


def test_simulators_are_told_of_the_robot() -> None:
    body = {"timestep_s": 0.192, "radius_m": 0.1, "speed_m_s": 0.25}
    assert NAVIGATION.simulator(1).parameters == pytest.approx(body)
    contact = {"reach_m": 0.22, "knock_m_s": 0.7, "kick_reach_m": 0.35, "kick_m_s": 1.0}
    assert KICK.simulator(1).parameters == pytest.approx(body | contact)


def test_a_ball_ends_states_and_a_wish_to_kick_ends_commands() -> None:
    for task, sizes in ((NAVIGATION, (29, 2, 2)), (KICK, (34, 2, 3))):
        by_name = {column.name: column for column in task.state_columns}
        assert tuple(by_name[name].size for name in (STATE, GOAL, ACTION)) == sizes
    state = KICK.state_columns[0]
    plain = NAVIGATION.state_columns[0]
    assert state.names is not None and plain.names is not None
    assert state.names[:29] == plain.names
    assert state.names[29:] == ("ball_x", "ball_y", "ball_vx", "ball_vy", "ball_unseen")


@pytest.mark.parametrize("task", NAO_TASKS, ids=lambda task: task.name)
def test_abstract_states_keep_the_entries_of_their_names(task: object) -> None:
    task = TASKS[task.name]  # type: ignore[attr-defined]
    state, abstract = task.state_columns[0], task.abstract_state
    assert state.names is not None and abstract.names is not None
    values = np.arange(state.size, dtype=np.float32)
    kept = [state.names[int(index)] for index in task.abstraction(values)]
    assert kept == list(abstract.names)
    beyond = task.beyond(torch.from_numpy(values))
    assert sorted([*beyond.tolist(), *task.abstraction(values).tolist()]) == values.tolist()
    for name, entries in task.quantities.items():
        # E.g. "ball_velocity_m_s": ball_vx and ball_vy, in m/s.
        words = abstract.astra or {}
        unit = "m/s" if name.endswith("m_s") else "m"
        assert [words["unit"][entry] for entry in entries] == [unit] * 2
        assert all(abstract.names[entry].startswith("ball") == name.startswith("ball") for entry in entries)


def test_mirror_images_of_the_joints_are_those_of_the_legs() -> None:
    state = NAVIGATION.state_columns[0]
    assert state.mirror is not None and state.names is not None
    source, sign = state.mirror
    first = state.names.index(JOINTS[0])
    rng = np.random.default_rng(0)
    values = np.zeros((5, state.size))
    values[:, first : first + 11] = rng.uniform(-0.3, 0.3, (5, 11))
    mirrored = (values[:, source] * sign)[:, first : first + 11]
    left, right = np.moveaxis(foot_poses(values[:, first : first + 11]), -2, 0)
    flip = [1, -1, 1, -1, 1, -1]  # y, roll and yaw of a pose
    expected = np.stack([right * flip, left * flip], axis=-2)
    np.testing.assert_allclose(foot_poses(mirrored), expected, atol=1e-12)
    assert (np.array(source)[source] == np.arange(state.size)).all()


def test_a_robot_that_is_sent_the_other_way_is_the_mirror_image_that_columns_record() -> None:
    env = NAVIGATION.target(2, seed=0, num_threads=1, errors=NO_ERRORS)
    assert isinstance(env, NaoEnv)
    env.robots.spread = IDENTICAL
    start = env.reset().double().numpy()
    start[:, 2:4] = [1.0, 0.0]
    env.reset_to(np.arange(2), start[[0, 0]])
    column = NAVIGATION.state_columns[0]
    assert column.mirror is not None
    source, sign = column.mirror
    numbers = np.arange(column.size)
    own = np.concatenate([numbers[group] for role, group in column.roles if role == "invariant"])
    seen = []
    for _ in range(8):
        env.robots.step(np.array([[0.1, 0.08, 0.3], [0.1, -0.08, -0.3]]))
        seen.append(env.state.double().numpy())
    states = np.array(seen)
    images = (states[:, 1, source] * sign)[:, own]
    np.testing.assert_allclose(images, states[:, 0, own], atol=5e-3)
    # No entry is so small that another sign or another side would do as well.
    is_kept = (np.array(source) == numbers) & (np.array(sign) > 0)
    told = np.where(is_kept, np.abs(states).max(axis=(0, 1)), np.abs(states[:, 1] - states[:, 0]).max(axis=0))
    assert (told[own] > 0.02).all()


def test_kicking_varies_what_walking_does_and_the_ball() -> None:
    for name, ends in WIDE_RANGES.model_dump().items():
        assert getattr(KICK_RANGES, name) == ends
    assert NAVIGATION.varied.wide == WIDE_RANGES and KICK.varied.wide == KICK_RANGES
    assert NAVIGATION.varied.randomized == KICK.varied.randomized
