from dataclasses import replace
from typing import Any

import pytest
import torch
from toy_episodes import toy_episodes

from astra_data.grounding.failures import FailureModel, FailureShape, averages_before
from astra_data.grounding.history import GroundedSimulator, HistoryGrounding
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.simulator import NO_GROUNDING, EpisodeSimulator, Grounding
from astra_data.policies.simulator_env import Simulation, SimulatorEnv, WorldConfig, data_starts, plus, training_env
from astra_data.robots.registry import TASKS
from astra_data.worlds.plane.point_mass import PointMass

TASK = TASKS["antmaze-umaze"]
FROM_DATA = WorldConfig(data_start_share=1.0)


@pytest.fixture
def episodes() -> PairedEpisodes:
    """Return two episodes of 400 and 300 steps around the middle of a corridor."""
    torch.manual_seed(0)
    here = torch.tensor(TASK.maze.cell_center(1, 2), dtype=torch.float32)
    state = torch.cat([here + 0.5 * torch.rand(2, 401, 2), torch.randn(2, 401, 2)], dim=-1)
    mask = torch.ones(2, 400)
    mask[1, 300:] = 0.0
    return toy_episodes(
        state[:, :-1], torch.rand(2, 400, 2) * 2 - 1, next_state=state[:, 1:], goal=torch.randn(2, 400, 2), mask=mask
    )


@pytest.fixture
def grounding() -> HistoryGrounding:
    torch.manual_seed(0)
    return HistoryGrounding(GroundingModel(GroundingShape(4, 2, 2, latent_size=8)))


def built(world: WorldConfig, grounding: Grounding, **given: Any) -> SimulatorEnv:
    options: dict[str, Any] = {"num_envs": 4, "device": "cpu"} | given
    return training_env(TASK, Simulation(world), grounding, **options)


def test_without_settings_it_is_the_plain_simulator(episodes: PairedEpisodes, grounding: HistoryGrounding) -> None:
    kinds: dict[type[EpisodeSimulator], Grounding] = {EpisodeSimulator: NO_GROUNDING, GroundedSimulator: grounding}
    for kind, used in kinds.items():
        assert data_starts(TASK, WorldConfig(), episodes, used) is None
        world = built(WorldConfig(), used)
        assert type(world.simulator) is kind and type(world.simulator.simulator) is PointMass
        assert (world.world, world.num_envs) == (WorldConfig(), 4)
        drawn = torch.get_rng_state()
        world.step(torch.zeros(4, 2))
        assert torch.equal(torch.get_rng_state(), drawn)


def test_plus_settings_reach_the_environment_and_leave_the_rest(episodes: PairedEpisodes) -> None:
    plain = WorldConfig(reward="predicted", data_start_share=0.3)
    settings = plus(plain, 0.75)
    changes = {"reward": "priced", "change_penalty": 0.02, "command_limit": 0.75}
    assert settings.model_dump() == plain.model_dump() | changes
    starts = data_starts(TASK, settings, episodes, NO_GROUNDING)
    world = built(settings, NO_GROUNDING, starts=starts)
    assert world.world == settings


@pytest.mark.parametrize(("reward", "prices"), [("abstract", False), ("predicted", True), ("priced", True)])
def test_a_failure_model_is_used_and_starts_know_what_it_remembers_where_failures_have_a_price(
    reward: Any, prices: bool, episodes: PairedEpisodes, grounding: HistoryGrounding
) -> None:
    failures = FailureModel(FailureShape(4, 2, TASK.timestep_s, members=1)).eval()
    foresees = replace(grounding, failures=failures)
    config = WorldConfig(reward=reward, data_start_share=0.5)
    starts = data_starts(TASK, config, episodes, foresees)
    assert starts is not None and starts.hidden is not None
    world: Any = built(config, foresees, starts=starts).simulator
    assert world.failures is (failures if prices else None)
    averages = averages_before(TASK, foresees, failures, episodes)
    assert float(averages[:, 50].abs().sum()) > 0
    known = averages[episodes.windows.mask.bool()] if prices else averages[0, :, :0]
    torch.testing.assert_close(starts.hidden[:, 8:], known if prices else starts.hidden[:, :0])
    hidden = grounding.hidden_before(episodes.windows)[episodes.windows.mask.bool()]
    assert torch.equal(starts.hidden[:, :8], hidden)


def test_recorded_starts_come_with_the_history_before_them(
    episodes: PairedEpisodes, grounding: HistoryGrounding
) -> None:
    starts = data_starts(TASK, FROM_DATA, episodes, grounding)
    assert starts is not None and starts.hidden is not None and len(starts.state) == len(starts.hidden) == 700
    windows, model = episodes.windows, grounding.model
    inputs = model.encoder_input(windows.state, windows.goal, windows.previous_action)
    hidden = torch.zeros(1, 8)
    for step in range(5):
        row = 400 + step  # of the second episode
        torch.testing.assert_close(starts.hidden[row : row + 1], hidden)
        assert torch.equal(starts.state[row], windows.state[1, step])
        assert torch.equal(starts.previous_action[row], windows.previous_action[1, step])
        hidden = model.encoder.step(inputs[1:, step], hidden)
