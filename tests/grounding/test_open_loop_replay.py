from dataclasses import replace

import pytest
import torch
from grounding_models import HERE, TASK, failure_model, members, model
from toy_episodes import toy_episodes

from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.open_loop_replay import replay_open_loop
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.raw import NO_GROUNDING

STEPS = 6


@pytest.fixture
def episodes() -> PairedEpisodes:
    """Three episodes that start apart; where the target went afterwards is not to be seen in a replay."""
    torch.manual_seed(1)
    state = HERE + torch.cat([0.2 * torch.rand(3, STEPS, 2), torch.zeros(3, STEPS, 2)], dim=-1)
    return toy_episodes(state, 2 * torch.rand(3, STEPS, 2) - 1, next_state=state)


def test_recorded_commands_are_replayed_from_where_episodes_began(episodes: PairedEpisodes) -> None:
    start, action = episodes.windows.state[:, :1, :2], episodes.windows.action
    position = torch.cat([start, start + (action * TASK.timestep_s).cumsum(1)], dim=1)
    found = replay_open_loop(TASK, NO_GROUNDING, episodes, seed=0)
    torch.testing.assert_close(found.state[..., :2], position)
    torch.testing.assert_close(found.state[:, 1:, 2:], action)
    assert found.hazard is None and found.disagreement is None


def test_a_grounding_of_one_correction_corrects_and_does_not_disagree(episodes: PairedEpisodes) -> None:
    grounding = HistoryGrounding(model(), failure_model())
    found = replay_open_loop(TASK, grounding, episodes, seed=0)
    simulator = grounding.simulator(TASK, 3)
    simulator.start(episodes.windows.state[:, 0], torch.arange(3), torch.zeros(3, 2))
    assert found.hazard is not None and found.disagreement is None
    for step in range(STEPS):
        state = simulator.step(episodes.windows.action[:, step])
        torch.testing.assert_close(found.state[:, step + 1], state)
        torch.testing.assert_close(found.hazard[:, step], simulator.failure_risk())


def test_hazards_are_told_where_the_failure_model_was_fitted(episodes: PairedEpisodes) -> None:
    """Where touching a wall is a failure, not within the recorded clearance."""
    grounding = HistoryGrounding(model(), failure_model(), clearance_m=1.5)
    touching = replace(TASK, objective=replace(TASK.objective, ends_at_walls=True))
    found = replay_open_loop(touching, grounding, episodes, seed=0).hazard
    free = replay_open_loop(touching, replace(grounding, clearance_m=None), episodes, seed=0).hazard
    held = replay_open_loop(TASK, grounding, episodes, seed=0).hazard
    assert found is not None and free is not None and held is not None
    assert torch.equal(found, free) and not torch.equal(found, held)


def test_members_disagree_by_their_mean_and_leave_path_and_hazards_to_the_model(
    episodes: PairedEpisodes,
) -> None:
    whole = HistoryGrounding(model(), failure_model(), members())
    for one in whole.members:
        one.usual_disagreement.fill_(1e-3)
    found = replay_open_loop(TASK, whole, episodes, seed=0)
    single = [
        replay_open_loop(TASK, replace(whole, members=(one,)), episodes, seed=0).disagreement
        for one in whole.members
    ]
    assert found.disagreement is not None and single[0] is not None and single[1] is not None
    assert found.disagreement.shape == (3, STEPS) and not torch.allclose(single[0], single[1])
    torch.testing.assert_close(found.disagreement, (single[0] + single[1]) / 2)
    alone = replay_open_loop(TASK, replace(whole, members=()), episodes, seed=0)
    assert alone.hazard is not None and found.hazard is not None
    assert torch.equal(found.state, alone.state) and torch.equal(found.hazard, alone.hazard)


def test_heads_disagree_too(episodes: PairedEpisodes) -> None:
    made = model(heads=2)
    made.usual_disagreement.fill_(1e-3)
    found = replay_open_loop(TASK, HistoryGrounding(made), episodes, seed=0)
    assert found.disagreement is not None and float(found.disagreement.max()) > 0
