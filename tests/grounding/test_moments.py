from typing import Any

import torch
from toy_episodes import toy_episodes

from astra_data.grounding.open_loop import Moments
from astra_data.grounding.simulator import EpisodeSimulator
from astra_data.robots.registry import TASKS

TASK = TASKS["antmaze-umaze"]


def moments() -> Moments:
    """Two episodes, of 7 and of 3 steps, every third of which is a moment."""
    torch.manual_seed(0)
    mask = torch.ones(2, 7)
    mask[1, 3:] = 0
    state = torch.tensor([0.0, 4.0, 0.0, 0.0]) + 0.1 * torch.rand(2, 7, 4)
    made = toy_episodes(state, torch.rand(2, 7, 2), next_state=state, goal=torch.rand(2, 7, 2), mask=mask)
    return Moments.every(made.windows, 3)


def test_they_are_real_steps_of_whole_episodes() -> None:
    made = moments()
    assert len(made) == 4
    assert list(zip(made.episode.tolist(), made.first.tolist(), strict=True)) == [
        (0, 0),
        (0, 3),
        (0, 6),
        (1, 0),
    ]
    assert torch.equal(made.state[1], made.windows.state[0, 3])
    assert torch.equal(made.previous_action[2], made.windows.action[0, 5])
    assert made.previous_action[3].tolist() == [0.0, 0.0]
    assert made.after(2).tolist() == [2, 5, 6, 2]
    episodes = [0, 0, 0, 1]
    assert torch.equal(made.action(2), made.windows.action[episodes, [2, 5, 6, 2]])


def test_a_row_of_the_simulator_starts_at_each() -> None:
    made = moments()
    started: dict[str, Any] = {}

    class Noting(EpisodeSimulator):
        def start(self, state: object, rows: object, goal: object, **others: object) -> None:
            started.update(state=state, rows=rows, goal=goal, **others)

    hidden = torch.rand(4, 5)
    made.start(Noting(TASK.simulator(4)), hidden)
    expected = {
        "state": made.state,
        "rows": torch.arange(4),
        "goal": made.windows.goal[made.episode, made.first],
        "hidden": hidden,
        "previous_action": made.previous_action,
    }
    assert started.keys() == expected.keys()
    assert all(torch.equal(started[name], values) for name, values in expected.items())
