from dataclasses import replace

import numpy as np
import pytest
import torch
from small_cart import LOGS_ALONE, TASK

from astra_data.grounding.committee import Rollouts
from astra_data.reports.suggestion import CELLS, maps_of, suggestion_page, with_units
from astra_data.training.proposals import Proposals, Suggestion, planned
from astra_data.training.recording_plan import RecordingPlan, names_of
from astra_data.worlds.registry import TASKS


@pytest.fixture
def suggestion() -> Suggestion:
    """Two proposals of four steps on the rail, from 0 and from 24 m; the second may end after two steps."""
    action = torch.tensor([[[-1.0], [1.0]]] * 3 + [[[1.0], [1.0]]])
    state = torch.tensor([[[0.5], [23.5]], [[0.6], [24.0]], [[0.7], [24.0]], [[0.0], [24.0]]])
    information = torch.tensor([[1.0, 2.0], [1.0, 2.0], [1.0, 2.0], [4.0, 8.0]])
    reached = torch.tensor([[1.0, 1.0], [1.0, 1.0], [1.0, 0.5], [1.0, 0.0]])
    starts, commands = names_of(TASK)
    one = planned(TASK, torch.tensor([23.5]), action[:, 1], 5.0)
    plan = RecordingPlan(
        task="rail", timestep_s=0.1, start_names=starts, command_names=commands, episodes=(one,)
    )
    return Suggestion(
        plan,
        Proposals(state[0], torch.zeros(2, 1), action),
        Rollouts(state, information, reached),
        np.array([1]),
        np.array([5.0]),
    )


def test_a_cell_has_the_mean_of_the_steps_that_are_reached(suggestion: Suggestion) -> None:
    found = maps_of(TASK, suggestion)
    state = found["state"]
    assert state["axes"] == ["x"] and np.allclose(state["edges"][0], np.linspace(0, 24, CELLS + 1))
    assert state["information"][0] == pytest.approx((3 * 1.0 + 4.0) / 4) and state["steps"][0] == 4
    assert state["information"][-1] == pytest.approx(2.0) and state["steps"][-1] == 2.5
    assert state["information"][1:-1] == [None] * (CELLS - 2)
    command = found["command"]
    assert command["axes"] == ["v"] and command["edges"][0][0] == -1.0 and command["edges"][0][-1] == 4.0
    assert command["steps"][0] == 3 and command["steps"][-1] == pytest.approx(1 + 2.5)


def test_units_are_named_where_they_are_known() -> None:
    assert with_units(TASKS["antmaze-umaze"].abstract_state) == ["x (m)", "y (m)", "vx (m/s)", "vy (m/s)"]


def test_the_page_says_where_to_start_what_to_hold_and_how_to_record_it(suggestion: Suggestion) -> None:
    maps = maps_of(TASK, suggestion)
    page = suggestion_page(TASK, suggestion, maps, named="rail.py:TASK", origin=["ground/nas/seed_0"])
    assert "| 0 | 23.5 | 5.0 | 0.2 |" in page and "| 0 | 0.00 | 0.40 | 4.000 |" in page
    assert "astra-data collect rail.py:TASK --plan FOLDER/plan.json --name more\n" in page
    alone = suggestion_page(LOGS_ALONE, suggestion, maps, named="rail.py:LOGS_ALONE", origin=["a", "b"])
    assert "bring it to each start" in alone and "astra-data collect" not in alone


def test_commands_follow_one_another(suggestion: Suggestion) -> None:
    action = torch.tensor([[1.0], [1.0], [-1.0], [1.0], [1.0]])
    plan = suggestion.plan.model_copy(update={"episodes": (planned(TASK, torch.zeros(1), action, 5.0),)})
    of = replace(suggestion, plan=plan)
    page = suggestion_page(TASK, of, maps_of(TASK, of), named="rail.py:TASK", origin=["ground/nas/seed_0"])
    held = ["| 0 | 0.00 | 0.20 | 4.000 |", "|  | 0.20 | 0.10 | -1.000 |", "|  | 0.30 | 0.20 | 4.000 |"]
    assert "\n".join(held) in page
    # Of 1 + 1 + 1 + 4 and 2 + 2 + 2 / 2 + 0 nats the second is taken.
    assert "6.0 per\nepisode on average, 5.0 in those suggested." in page


def test_the_cells_that_teach_most_come_first_unless_hardly_a_step_is_in_them(suggestion: Suggestion) -> None:
    cells = {
        "axes": ["x"],
        "edges": [[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]],
        "information": [1.0, 3.0, None, 2.0, 9.0],
        "steps": [20.0, 30.0, 0.0, 25.0, 19.0],
    }
    maps = {"state": cells, "command": cells}
    page = suggestion_page(TASK, suggestion, maps, named="rail.py:TASK", origin=["ground/nas/seed_0"])
    lines = [
        "| 1.00 to 2.00 | 3.000 | 30 |",
        "| 3.00 to 4.00 | 2.000 | 25 |",
        "| 0.00 to 1.00 | 1.000 | 20 |",
    ]
    assert "| --- | ---: | ---: |\n" + "\n".join(lines) + "\n\n" in page and "| 4.00 to 5.00" not in page
