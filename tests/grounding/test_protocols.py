import pytest
import torch

from astra_data.grounding.history import HistoryGrounding
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.learning.networks.paired_windows import PairedWindows
from astra_data.worlds.registry import TASKS

TASK = TASKS["antmaze-umaze"]
STEPS, COUNT = 11, 3


def history() -> HistoryGrounding:
    model = GroundingModel(GroundingShape(4, 2, 2, latent_size=8))
    with torch.no_grad():
        list(model.corrections.parameters())[-2].normal_(std=0.05)
    return HistoryGrounding(model)


@pytest.mark.parametrize("every", [1, 4])
@torch.no_grad()
def test_an_episode_taken_up_in_its_midst_goes_on_as_it_went(every: int) -> None:
    torch.manual_seed(0)
    grounding = history()
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
    nothing = torch.zeros(COUNT, STEPS)
    windows = PairedWindows(
        state=torch.stack(states[:-1], dim=1),
        action=action,
        previous_action=previous,
        goal=goal.unsqueeze(1).expand(COUNT, STEPS, 2),
        simulated_next=torch.stack(simulated, dim=1),
        next_state=torch.stack(states[1:], dim=1),
        reward=torch.zeros(COUNT, STEPS, 2),
        goes_on=torch.ones_like(nothing),
        failed=nothing,
        fails_soon=nothing,
        mask=torch.ones(COUNT, STEPS),
    )
    hidden = grounding.hidden_before(windows, every)
    assert hidden is not None
    assert hidden.shape[:2] == (COUNT, -(-STEPS // every))
    for index, first in enumerate(range(0, STEPS, every)):
        late = grounding.simulator(TASK, COUNT)
        late.start(states[first], rows, goal, hidden=hidden[:, index], previous_action=previous[:, first])
        for step in range(first, STEPS):
            torch.testing.assert_close(late.step(action[:, step]), states[step + 1])
