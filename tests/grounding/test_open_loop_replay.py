import pytest
import torch
from grounding_models import HERE, TASK, failure_model, model
from toy_episodes import toy_episodes

from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.open_loop import replay_open_loop
from astra_data.grounding.simulator import NO_GROUNDING, Grounding

STEPS = 6


@pytest.mark.parametrize("grounding", [NO_GROUNDING, HistoryGrounding(model(), failure_model())])
def test_recorded_commands_are_replayed_from_where_episodes_began(grounding: Grounding) -> None:
    """Three episodes that start apart; where the target went afterwards is not to be seen in a replay."""
    torch.manual_seed(1)
    state = HERE + torch.cat([0.2 * torch.rand(3, STEPS, 2), torch.zeros(3, STEPS, 2)], dim=-1)
    episodes = toy_episodes(state, 2 * torch.rand(3, STEPS, 2) - 1, next_state=state)
    found = replay_open_loop(TASK, grounding, episodes, seed=0)
    simulator = grounding.simulator(TASK, 3)
    simulator.start(state[:, 0], torch.arange(3), torch.zeros(3, 2))
    assert torch.equal(found[:, 0], state[:, 0]) and found.shape == (3, STEPS + 1, 4)
    for step in range(STEPS):
        torch.testing.assert_close(found[:, step + 1], simulator.step(episodes.windows.action[:, step]))
