from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, Array, Column
from astra_data.robots.ant.body import ant_model
from astra_data.robots.ant.tasks import AntMazeEnv
from astra_data.robots.registry import TASKS
from astra_data.worlds.batched_mujoco import BatchedPhysics
from astra_data.worlds.geometry import PlanarMap, rotation_matrix, wrapped
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.plane.navigation import Navigation
from astra_data.worlds.plane.point_mass import PointMass
from astra_data.worlds.task import Task

angles = st.floats(-10, 10)
meters = st.floats(-20, 20)
maps = st.builds(PlanarMap, angles, st.tuples(meters, meters))
properties = settings(max_examples=20, deadline=None)

TASK = TASKS["antmaze-umaze"]
STATE_COLUMN, _, ACTION_COLUMN, _ = TASK.state_columns
PLANAR = {name: task for name, task in TASKS.items() if task.plane is not None}
COLUMNS = {
    f"{task.name} {column.name}": column
    for task in PLANAR.values()
    for column in (*task.state_columns, task.abstract_state)
}
OPEN = Maze(rows=("111", "101", "111"), scale=24.0, start=(1, 1), goal=(1, 1))
"""Walls so far off that nobody meets them."""


def matrix(change: PlanarMap) -> Array:
    """Write a map as a matrix (4, 4) of space."""
    cos, sin = np.cos(change.rotation_rad), np.sin(change.rotation_rad)
    whole = np.eye(4)
    whole[:2, :2] = [[cos, -sin], [sin, cos]]
    whole[:2, 3] = change.shift_m
    return whole


def random_values(column: Column, count: int, seed: int = 0) -> Array:
    """Return values (count, size) of a column, its quaternions of unit length."""
    values = np.random.default_rng(seed).normal(size=(count, column.size))
    for role, group in column.roles:
        if role == "quaternion":
            values[:, group] /= np.linalg.norm(values[:, group], axis=1, keepdims=True)
    return values


@properties
@given(maps)
def test_points_and_directions_move_as_a_matrix_says(change: PlanarMap) -> None:
    values = np.random.default_rng(0).normal(size=(3, 4, 2))
    whole = matrix(change)
    np.testing.assert_allclose(change.positions(values), values @ whole[:2, :2].T + whole[:2, 3], atol=1e-12)
    np.testing.assert_allclose(change.vectors(values), values @ whole[:2, :2].T, atol=1e-12)
    heading = np.arctan2(values[..., 1], values[..., 0])
    turned = change.vectors(values)
    moved = change.headings(heading)
    assert (np.abs(moved) <= np.pi).all()
    np.testing.assert_allclose(wrapped(moved - np.arctan2(turned[..., 1], turned[..., 0])), 0, atol=1e-9)


@properties
@given(maps)
def test_bodies_turn_as_a_matrix_says(change: PlanarMap) -> None:
    quaternions = np.random.default_rng(0).normal(size=(5, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    moved = change.quaternions(quaternions)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 1, atol=1e-12)
    expected = matrix(change)[:3, :3] @ rotation_matrix(quaternions)
    np.testing.assert_allclose(rotation_matrix(moved), expected, atol=1e-12)


def test_half_a_turn_is_minus_pi() -> None:
    turns = np.array([np.pi, -np.pi, 3 * np.pi, 0.5 - 2 * np.pi])
    expected = [-np.pi, -np.pi, -np.pi, 0.5]
    np.testing.assert_allclose(wrapped(turns), expected, atol=1e-12)
    np.testing.assert_allclose(wrapped(torch.from_numpy(turns)), expected, atol=1e-12)


@pytest.mark.parametrize("column", COLUMNS.values(), ids=COLUMNS)
def test_columns_of_every_task_tell_all(column: Column) -> None:
    words = column.astra or {}
    assert {len(words[key]) for key in ("unit", "frame", "role")} == {column.size}
    for frame, role in zip(words["frame"], words["role"], strict=True):
        # What is measured in the body does not turn with the world.
        assert role == "invariant" or frame == "world"


def test_values_keep_their_type_and_lone_headings_their_shape() -> None:
    yaw = Column("yaw", astra={"role": ["heading"]})
    moved = PlanarMap(rotation_rad=np.pi).of_column(yaw, np.array([0.5, -0.5], np.float32))
    assert moved.dtype == np.float32
    assert moved.shape == (2,)
    np.testing.assert_allclose(moved, [0.5 - np.pi, np.pi - 0.5], rtol=1e-6)


def test_a_column_without_roles_is_refused() -> None:
    with pytest.raises(BadInputError, match="column action has no roles: expected one for each of its"):
        PlanarMap().of_column(Column(ACTION, size=2), np.zeros((2, 2), np.float32))


@properties
@given(maps)
@pytest.mark.parametrize("task", PLANAR.values(), ids=PLANAR)
def test_the_abstraction_commutes(task: Task, change: PlanarMap) -> None:
    column = task.state_columns[0]
    state = random_values(column, 5)
    np.testing.assert_allclose(
        task.abstraction(change.of_column(column, state)),
        change.of_column(task.abstract_state, task.abstraction(state)),
        atol=1e-12,
    )


POINTS = PointMass(OPEN, 8, timestep_s=0.05)


def small(change: PlanarMap) -> PlanarMap:
    """Keep near the origin, where `OPEN` is free."""
    return replace(change, shift_m=(change.shift_m[0] / 4, change.shift_m[1] / 4))


@properties
@given(maps)
def test_the_point_mass_does_not_feel_the_map(change: PlanarMap) -> None:
    change = small(change)
    rng = np.random.default_rng(1)
    # Commands in a disc, so that no turn takes them out of the square that the point mass obeys.
    bearing, speed = rng.uniform(-np.pi, np.pi, 8), rng.uniform(0, 1, 8)
    action = speed[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    state = rng.uniform(-5, 5, (8, 4))

    def stepped(state: Array, action: Array) -> Array:
        simulator = copy(POINTS)
        simulator.reset_to(torch.from_numpy(state).float())
        return simulator.step(torch.from_numpy(action).float()).double().numpy()

    column = TASK.abstract_state
    moved = stepped(change.of_column(column, state), change.of_column(ACTION_COLUMN, action))
    np.testing.assert_allclose(moved, change.of_column(column, stepped(state, action)), atol=2e-4)


def walking(count: int, steps: int) -> Array:
    """Return states (count, 29) of ants that have walked for a while, in contact with the ground."""
    env = AntMazeEnv(Navigation(OPEN, horizon=100), count, seed=3, num_threads=1)
    env.reset()
    command = torch.from_numpy(np.random.default_rng(4).uniform(-1, 1, (count, 2)))
    for _ in range(steps):
        env.step(command)
    return np.concatenate([env.physics.qpos, env.physics.qvel], axis=1)


WALKING = walking(3, 12)
TORQUES = np.random.default_rng(5).uniform(-1, 1, (3, 8))


def physics_step(state: Array, torques: Array) -> Array:
    physics = BatchedPhysics(ant_model(), len(state), substeps=2, num_threads=1)
    physics.set_state(np.arange(len(state)), state[:, :15], state[:, 15:])
    physics.step(torques)
    return np.concatenate([physics.qpos, physics.qvel], axis=1)


def ant_error(change: PlanarMap, column: Column, state: Array) -> float:
    """Return how far a step of the moved ant is from the moved step of the ant."""
    moved = physics_step(change.of_column(column, state), TORQUES)
    return float(np.abs(moved - change.of_column(column, physics_step(state, TORQUES))).max())


def airborne(state: Array) -> Array:
    high = state.copy()
    high[:, 2] += 3.0
    return high


@properties
@given(maps)
def test_the_ant_in_the_air_does_not_feel_any_map(change: PlanarMap) -> None:
    assert ant_error(small(change), STATE_COLUMN, airborne(WALKING)) < 1e-7


@properties
@given(maps)
def test_the_ant_on_the_ground_does_not_feel_any_map(change: PlanarMap) -> None:
    assert ant_error(small(change), STATE_COLUMN, WALKING) < 1e-4


@pytest.mark.parametrize(
    "changes",
    [
        {"wx": "vector", "wy": "vector"},
        {"vx": "invariant", "vy": "invariant"},
        {"qw": "invariant", "qx": "invariant", "qy": "invariant", "qz": "invariant"},
    ],
)
def test_wrong_roles_are_felt(changes: dict[str, str]) -> None:
    astra: dict[str, Any] = {
        "role": [
            changes.get(name, word)
            for name, word in zip(STATE_COLUMN.names or (), (STATE_COLUMN.astra or {})["role"], strict=True)
        ]
    }
    wrong = replace(STATE_COLUMN, astra=astra)
    assert ant_error(PlanarMap(2.0, (1.0, -2.0)), wrong, airborne(WALKING)) > 1e-3


@settings(max_examples=8, deadline=None)
@given(angles)
def test_the_walking_ant_follows_the_turned_command(rotation: float) -> None:
    change = PlanarMap(rotation, (1.0, -2.0))
    # Short enough for any turn to stay within 1 m/s along each axis.
    command = np.random.default_rng(6).uniform(-0.7, 0.7, (3, 2))

    def stepped(state: Array, command: Array) -> Array:
        env = AntMazeEnv(Navigation(OPEN, horizon=100), len(state), seed=0, num_threads=1)
        env.reset_to(np.arange(len(state)), state)
        env.step(torch.from_numpy(command))
        return np.concatenate([env.physics.qpos, env.physics.qvel], axis=1)

    moved = stepped(change.of_column(STATE_COLUMN, WALKING), change.of_column(ACTION_COLUMN, command))
    np.testing.assert_allclose(moved, change.of_column(STATE_COLUMN, stepped(WALKING, command)), atol=1e-4)
