import pytest
import torch
from grounding_models import TASK, model
from toy_episodes import toy_episodes

from astra_data.grounding.history import HistoryGrounding

STEPS, COUNT = 11, 3


@pytest.mark.parametrize("every", [1, 4])
@torch.no_grad()
def test_an_episode_taken_up_in_its_midst_goes_on_as_it_went(every: int) -> None:
    torch.manual_seed(0)
    grounding = HistoryGrounding(model())
    goal, action = torch.randn(COUNT, 2), 2 * torch.rand(COUNT, STEPS, 2) - 1
    start = torch.tensor([[*TASK.maze.cell_center(1, 1), 0.0, 0.0]]).float().expand(COUNT, 4)
    rows = torch.arange(COUNT)
    whole = grounding.simulator(TASK, COUNT)
    whole.start(start, rows, goal)
    raw = TASK.simulator(COUNT)
    states, simulated = [start], []
    for step in range(STEPS):
        raw.reset_to(states[-1])
        simulated.append(raw.step(action[:, step]))
        states.append(whole.step(action[:, step]))
    previous = torch.cat([torch.zeros(COUNT, 1, 2), action[:, :-1]], dim=1)
    windows = toy_episodes(
        *(torch.stack(states[:-1], dim=1), action),
        next_state=torch.stack(states[1:], dim=1),
        simulated_next=torch.stack(simulated, dim=1),
        goal=goal.unsqueeze(1).expand(COUNT, STEPS, 2),
    ).windows
    hidden = grounding.hidden_before(windows, every)
    assert hidden is not None and hidden.shape[:2] == (COUNT, -(-STEPS // every))
    for index, first in enumerate(range(0, STEPS, every)):
        late = grounding.simulator(TASK, COUNT)
        late.start(states[first], rows, goal, hidden=hidden[:, index], previous_action=previous[:, first])
        for step in range(first, STEPS):
            torch.testing.assert_close(late.step(action[:, step]), states[step + 1], atol=1e-4, rtol=1e-4)
