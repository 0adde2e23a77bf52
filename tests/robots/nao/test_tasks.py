import numpy as np
import pytest
import torch

from astra_data.dataset.columns import ACTION, GOAL, STATE
from astra_data.robots.ant.tasks import UMAZE
from astra_data.robots.nao.tasks import KICK, NAVIGATION
from astra_data.worlds.task import Task


def test_a_ball_ends_states_and_a_wish_to_kick_ends_commands() -> None:
    for task, sizes in ((NAVIGATION, (29, 2, 2)), (KICK, (34, 2, 3))):
        by_name = {column.name: column for column in task.state_columns}
        assert tuple(by_name[name].size for name in (STATE, GOAL, ACTION)) == sizes
    state = KICK.state_columns[0]
    plain = NAVIGATION.state_columns[0]
    assert state.names is not None and plain.names is not None and state.names[:29] == plain.names
    assert state.names[29:] == ("ball_x", "ball_y", "ball_vx", "ball_vy", "ball_unseen")


@pytest.mark.parametrize("task", [NAVIGATION, KICK, UMAZE], ids=lambda task: task.name)
def test_abstract_states_keep_the_entries_of_their_names(task: Task) -> None:
    state, abstract = task.state, task.abstract_state
    eye = torch.eye(state.size)
    kept = task.abstraction(eye)
    assert [state.labels[index] for index in kept.argmax(dim=0)] == [*abstract.labels]
    np.testing.assert_array_equal(task.abstraction(eye.double().numpy()), kept)
    assert torch.equal(task.beyond(eye).any(dim=1), ~kept.any(dim=1))
    for name, entries in task.quantities.items():
        words = abstract.astra or {}  # e.g. "ball_velocity_m_s": ball_vx and ball_vy, in m/s
        unit = "m/s" if name.endswith("m_s") else "m"
        assert [words["unit"][entry] for entry in entries] == [unit] * 2
        assert all(abstract.labels[entry].startswith("ball") == name.startswith("ball") for entry in entries)
