import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, Array, Column
from astra_data.robots.registry import TASKS
from astra_data.worlds.geometry import PlanarMap, rotation_matrix, wrapped
from astra_data.worlds.task import Task

angles = st.floats(-10, 10)
meters = st.floats(-20, 20)
maps = st.builds(PlanarMap, angles, st.tuples(meters, meters))
properties = settings(max_examples=20, deadline=None)

TASK = TASKS["antmaze-umaze"]
PLANAR = {name: task for name, task in TASKS.items() if task.plane is not None}
COLUMNS = {
    f"{task.name} {column.name}": column
    for task in PLANAR.values()
    for column in (*task.state_columns, task.abstract_state)
}


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


def test_columns_of_every_task_tell_all() -> None:
    for name, column in COLUMNS.items():
        words = column.astra or {}
        assert {len(words[key]) for key in ("unit", "frame", "role")} == {column.size}, name
        for frame, role in zip(words["frame"], words["role"], strict=True):
            # What is measured in the body does not turn with the world.
            assert role == "invariant" or frame == "world", name


def test_values_keep_their_type_and_lone_headings_their_shape() -> None:
    yaw = Column("yaw", astra={"role": ["heading"]})
    moved = PlanarMap(rotation_rad=np.pi).of_column(yaw, np.array([0.5, -0.5], np.float32))
    assert moved.dtype == np.float32 and moved.shape == (2,)
    np.testing.assert_allclose(moved, [0.5 - np.pi, np.pi - 0.5], rtol=1e-6)
    both = Column("both", size=4, astra={"role": ["position", "position", "vector", "vector"]})
    moved = PlanarMap(np.pi / 2, (1.0, 2.0)).of_column(both, np.array([[3.0, 4.0, 3.0, 4.0]]))
    np.testing.assert_allclose(moved, [[1.0 - 4.0, 2.0 + 3.0, -4.0, 3.0]])


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


def test_rotation_matrix_is_mujocos() -> None:
    quaternions = np.random.default_rng(0).normal(size=(50, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    for quaternion, matrix in zip(quaternions, rotation_matrix(quaternions), strict=True):
        theirs = np.zeros(9)
        mujoco.mju_quat2Mat(theirs, quaternion)
        np.testing.assert_allclose(matrix.ravel(), theirs, atol=1e-14)
