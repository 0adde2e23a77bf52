from dataclasses import replace

import pytest
import torch
from pydantic import ValidationError
from toy_episodes import toy_episodes

from astra_data.core.errors import BadInputError
from astra_data.grounding.failures import averages_before
from astra_data.grounding.grounded_simulator import GroundedSimulator
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import Grounding
from astra_data.grounding.raw import NO_GROUNDING
from astra_data.grounding.simulator import EpisodeSimulator
from astra_data.learning.networks.failure import FailureModel, FailureShape
from astra_data.learning.networks.grounding import GroundingModel, GroundingShape
from astra_data.training.build_env import (
    EnvConfig,
    data_starts,
    recorded_steps,
    simulation_of,
    training_env,
)
from astra_data.training.ramp import Ramp
from astra_data.training.simulator_env import policy_observation
from astra_data.worlds.plane.free_space import FreeSpace
from astra_data.worlds.plane.point_mass import PointMass
from astra_data.worlds.registry import TASKS

TASK = TASKS["antmaze-umaze"]
HERE = torch.tensor(TASK.maze.cell_center(1, 2), dtype=torch.float32)


@pytest.fixture
def episodes() -> PairedEpisodes:
    """Return two episodes of 400 and 300 steps around the middle of a corridor."""
    torch.manual_seed(0)
    state = torch.cat([HERE + 0.5 * torch.rand(2, 401, 2), torch.randn(2, 401, 2)], dim=-1)
    action = torch.rand(2, 400, 2) * 2 - 1
    mask = torch.ones(2, 400)
    mask[1, 300:] = 0.0
    scale = torch.tensor([0.01, 0.02, 0.1, 0.2])
    return toy_episodes(
        state[:, :-1],
        action,
        next_state=state[:, 1:],
        simulated_next=state[:, 1:] + scale * torch.randn(2, 400, 4),
        goal=torch.randn(2, 400, 2),
        mask=mask,
    )


@pytest.fixture
def grounding() -> HistoryGrounding:
    torch.manual_seed(0)
    return HistoryGrounding(GroundingModel(GroundingShape(4, 2, 2, latent_size=8)))


def test_without_switches_it_is_the_plain_simulator(
    episodes: PairedEpisodes, grounding: HistoryGrounding
) -> None:
    config = EnvConfig()
    kinds: dict[type[EpisodeSimulator], Grounding] = {
        EpisodeSimulator: NO_GROUNDING,
        GroundedSimulator: grounding,
    }
    for kind, used in kinds.items():
        simulation = simulation_of(TASK, config, episodes, used)
        assert not simulation.scatter.any()
        assert data_starts(TASK, config, episodes, used) is None
        world = training_env(TASK, simulation, used, num_envs=4, device="cpu")
        assert type(world.simulator) is kind
        assert type(world.simulator.simulator) is PointMass
        assert world.simulator.scatter is None
        assert world.reward == "abstract"
        assert world.num_envs == 4
        drawn = torch.get_rng_state()
        world.step(torch.zeros(4, 2))
        assert torch.equal(torch.get_rng_state(), drawn)


@torch.no_grad()
def test_recorded_steps_show_what_was_known_before_each(
    episodes: PairedEpisodes, grounding: HistoryGrounding
) -> None:
    windows, model = episodes.windows, grounding.model
    for used in (NO_GROUNDING, grounding):
        recorded = recorded_steps(TASK, episodes, used)
        hidden, previous = torch.zeros(2, 8), torch.zeros(2, 2)
        for step in range(6):
            state, goal, latent = windows.state[:, step], windows.goal[:, step], None
            if used is grounding:
                hidden = model.encoder.step(model.encoder_input(state, goal, previous), hidden)
                latent = model.encoder.latent(hidden)
            seen = policy_observation(TASK.objective, state, goal, latent)
            torch.testing.assert_close(recorded.observation[:, step], seen)
            assert torch.equal(recorded.previous_action[:, step], previous)
            previous = windows.action[:, step]
            assert torch.equal(recorded.action[:, step], previous)
        assert recorded.lengths.tolist() == [400, 300]


def test_failures_are_foreseen_where_rewards_or_ends_depend_on_them() -> None:
    assert [EnvConfig(reward=reward).foresees for reward in (None, "abstract", "predicted", "blend")] == [
        *(False, False, True, True)
    ]
    assert EnvConfig(topple=True).foresees


def test_penalties_grow_as_settings_say() -> None:
    assert EnvConfig(ramp=0.4, ramp_while=0.5).penalty_ramp == Ramp(0.4, 0.5)
    with pytest.raises(ValidationError, match="ramp_while: expected a ramp"):
        EnvConfig(ramp_while=0.5)


def test_rows_may_differ_by_their_members(episodes: PairedEpisodes) -> None:
    torch.manual_seed(0)
    model, *members = (GroundingModel(GroundingShape(4, 2, 2, latent_size=8)) for _ in range(3))
    for one in members:
        torch.nn.init.normal_(list(one.corrections.parameters())[-2], std=0.05)
    used = HistoryGrounding(model, None, tuple(members))
    for keeps in (False, True):
        config = EnvConfig(keep_member=keeps, data_start_share=0.5)
        simulation = simulation_of(TASK, config, episodes, used)
        starts = data_starts(TASK, config, episodes, used)
        world = training_env(TASK, simulation, used, num_envs=16, device="cpu", starts=starts)
        world.reset()  # half of them from recorded moments, with what the simulator remembers of them
        start = torch.cat([HERE, torch.zeros(2)]).expand(16, 4)
        world.simulator.start(start, torch.arange(16), torch.zeros(16, 2))
        with torch.no_grad():
            landed = world.simulator.step(torch.full((16, 2), 0.5))
        assert len(landed.unique(dim=0)) == (2 if keeps else 1)


def test_starts_within_the_data_know_what_a_failure_model_remembers(
    episodes: PairedEpisodes, grounding: HistoryGrounding
) -> None:
    failures = FailureModel(FailureShape(4, 2, TASK.timestep_s, members=1)).eval()
    foresees = replace(grounding, failures=failures)
    seen = {}
    for reward in ("abstract", "blend"):
        config = EnvConfig.model_validate({"reward": reward, "data_start_share": 0.5})
        starts = data_starts(TASK, config, episodes, foresees)
        assert starts is not None
        assert starts.hidden is not None
        seen[reward] = starts.hidden
    averages = averages_before(TASK, foresees, failures, episodes)
    assert torch.equal(seen["blend"][:, :8], seen["abstract"])
    assert torch.equal(seen["blend"][:, 8:], averages[episodes.windows.mask.bool()])
    assert float(averages[:, 50].abs().sum()) > 0


def test_scatter_is_what_the_simulator_does_not_explain(
    episodes: PairedEpisodes, grounding: HistoryGrounding
) -> None:
    config = EnvConfig(residual_noise=2.0)
    simulation = simulation_of(TASK, config, episodes, NO_GROUNDING)
    world = training_env(TASK, simulation, NO_GROUNDING, num_envs=1, device="cpu")
    assert world.simulator.scatter is simulation.scatter
    deviations = (simulation.scatter @ simulation.scatter.T).diagonal().sqrt()
    torch.testing.assert_close(deviations, 2 * torch.tensor([0.01, 0.02, 0.1, 0.2]), rtol=0.1, atol=0)
    grounding.model.residual_factor.copy_(torch.eye(4))
    assert torch.equal(simulation_of(TASK, config, episodes, grounding).scatter, 2 * torch.eye(4))


def test_data_is_thin_where_nobody_was(episodes: PairedEpisodes) -> None:
    thinness = simulation_of(TASK, EnvConfig(), episodes, NO_GROUNDING).thinness
    assert thinness is not None
    cells = FreeSpace.of_maze(TASK.maze, radius_m=0.0).cells
    far = HERE + torch.tensor([[1.5, 0.0], [0.0, -1.5]])
    assert (thinness[cells(far)] == 1.0).all()
    visited = episodes.steps(episodes.windows.state)[:, :2]
    assert float(thinness[cells(visited)].mean()) < 0.1


def test_what_is_enough_is_a_share_of_the_usual_density(episodes: PairedEpisodes) -> None:
    height, width = TASK.maze.fine_walls.shape
    extent = torch.tensor([width, height]) * TASK.maze.fine_m
    everywhere = torch.cat([extent * (torch.rand(2, 400, 2) - 0.5), torch.zeros(2, 400, 2)], dim=-1)
    spread = replace(episodes, windows=replace(episodes.windows, state=everywhere))
    little, more = (
        simulation_of(TASK, EnvConfig(support_density=share), spread, NO_GROUNDING).thinness
        for share in (0.4, 0.8)
    )
    assert little is not None and more is not None
    some = little > 0
    assert some.sum() > 10
    torch.testing.assert_close(0.4 * (1 - little[some]), 0.8 * (1 - more[some]))


def test_thin_data_costs_its_share_of_the_penalty(episodes: PairedEpisodes) -> None:
    config = EnvConfig(support_penalty=0.3)
    simulation = simulation_of(TASK, config, episodes, NO_GROUNDING)
    world = training_env(TASK, simulation, NO_GROUNDING, num_envs=1, device="cpu")
    assert world.thinness is not None and simulation.thinness is not None
    torch.testing.assert_close(world.thinness, 0.3 * simulation.thinness)
    free = training_env(TASK, replace(simulation, world=EnvConfig()), NO_GROUNDING, num_envs=1, device="cpu")
    assert free.thinness is None


def test_what_needs_a_maze_is_refused_without_one(episodes: PairedEpisodes) -> None:
    nowhere = replace(TASK, plane=None)
    plain, *asked = EnvConfig(), EnvConfig(support_penalty=0.3), EnvConfig(command_limit=1.0)
    simulation = simulation_of(nowhere, plain, episodes, NO_GROUNDING)
    assert simulation.thinness is None
    world = training_env(nowhere, simulation, NO_GROUNDING, num_envs=1, device="cpu")
    assert world.thinness is None
    for config in asked:
        with pytest.raises(BadInputError, match="expected a task in a maze"):
            training_env(nowhere, replace(simulation, world=config), NO_GROUNDING, num_envs=1, device="cpu")


def test_recorded_starts_come_with_the_history_before_them(
    episodes: PairedEpisodes, grounding: HistoryGrounding
) -> None:
    config = EnvConfig(data_start_share=1.0)
    starts = data_starts(TASK, config, episodes, grounding)
    assert starts is not None
    assert starts.hidden is not None
    assert len(starts.state) == len(starts.hidden) == 700
    windows, model = episodes.windows, grounding.model
    inputs = model.encoder_input(windows.state, windows.goal, windows.previous_action)
    hidden = torch.zeros(1, 8)
    for step in range(5):
        row = 400 + step  # of the second episode
        torch.testing.assert_close(starts.hidden[row : row + 1], hidden)
        assert torch.equal(starts.state[row], windows.state[1, step])
        assert torch.equal(starts.previous_action[row], windows.previous_action[1, step])
        hidden = model.encoder.step(inputs[1:, step], hidden)


def test_a_recorded_start_is_one_of_the_recorded_moments(
    episodes: PairedEpisodes, grounding: HistoryGrounding
) -> None:
    few = replace(
        episodes, windows=replace(episodes.windows, mask=(torch.arange(400) < 3) * torch.ones(2, 1))
    )
    config = EnvConfig(data_start_share=1.0)
    simulation = simulation_of(TASK, config, few, grounding)
    starts = data_starts(TASK, config, few, grounding)
    world = training_env(TASK, simulation, grounding, num_envs=64, device="cpu", starts=starts)
    world.reset()
    moments = few.steps(few.windows.state)
    assert len(moments) == 6
    assert torch.equal(world.simulator.state.unique(dim=0), moments.unique(dim=0))


def test_plenty_of_data_is_no_bonus(episodes: PairedEpisodes) -> None:
    thinness = simulation_of(TASK, EnvConfig(), episodes, NO_GROUNDING).thinness
    assert thinness is not None
    assert (float(thinness.min()), float(thinness.max())) == (0.0, 1.0)


def test_data_counts_for_what_is_near_it(episodes: PairedEpisodes) -> None:
    """A kernel of 0.25 m ends at four of its deviations, 1 m."""
    here = torch.cat([HERE, torch.zeros(2)]).expand(2, 400, 4)
    alone = replace(episodes, windows=replace(episodes.windows, state=here))
    thinness = simulation_of(TASK, EnvConfig(), alone, NO_GROUNDING).thinness
    assert thinness is not None
    cells = FreeSpace.of_maze(TASK.maze, radius_m=0.0).cells
    near, far = (HERE + torch.tensor([[apart, 0.0], [-apart, 0.0], [0.0, -apart]]) for apart in (0.8, 1.2))
    assert not thinness[cells(near)].any()
    assert (thinness[cells(far)] == 1.0).all()


def test_the_usual_density_is_that_of_the_free_space() -> None:
    """With data in every free cell the middle of a corridor is as dense as is usual."""
    free = torch.from_numpy(~TASK.maze.fine_walls).nonzero().flip(1)  # columns are x
    places = (free + 0.5) * TASK.maze.fine_m - torch.as_tensor(TASK.maze.half_extent)
    state = torch.cat([places, torch.zeros(len(places), 2)], dim=-1).float()[None]
    everywhere = toy_episodes(state, torch.zeros(1, len(places), 2), next_state=state)
    thinness = simulation_of(TASK, EnvConfig(support_density=2.0), everywhere, NO_GROUNDING).thinness
    assert thinness is not None
    cells = FreeSpace.of_maze(TASK.maze, radius_m=0.0).cells
    assert float(thinness[cells(HERE[None])]) == pytest.approx(0.5, abs=0.02)


def test_episodes_begin_at_every_so_many_steps_as_the_grounding_says(episodes: PairedEpisodes) -> None:
    class EveryTenth(HistoryGrounding):
        start_stride = 10

    used = EveryTenth(GroundingModel(GroundingShape(4, 2, 2, latent_size=8)))
    starts = data_starts(TASK, EnvConfig(data_start_share=1.0), episodes, used)
    windows = episodes.windows
    assert starts is not None and starts.hidden is not None and len(starts.hidden) == 40 + 30
    for found, recorded in (
        (starts.state, windows.state),
        (starts.goal, windows.goal),
        (starts.previous_action, windows.previous_action),
    ):
        assert torch.equal(found, torch.cat([recorded[0, ::10], recorded[1, :300:10]]))
