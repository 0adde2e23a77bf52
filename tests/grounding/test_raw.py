import torch
from toy_episodes import toy_episodes

from astra_data.grounding.protocols import Grounding
from astra_data.grounding.raw import NO_GROUNDING, scatter_factor
from astra_data.grounding.simulator import EpisodeSimulator
from astra_data.worlds.plane.point_mass import PointMass
from astra_data.worlds.registry import TASKS
from astra_data.worlds.variation import VariedSimulator

TASK = TASKS["antmaze-umaze"]


def test_the_scatter_factor_is_triangular_and_its_square_the_covariance() -> None:
    torch.manual_seed(0)
    residual = torch.randn(500, 3) @ torch.tensor([[1.0, 0.5, 0.0], [0.0, 0.2, 0.1], [0.0, 0.0, 3.0]])
    factor = scatter_factor(residual)
    centered = residual - residual.mean(0)
    torch.testing.assert_close(factor @ factor.T, centered.T @ centered / 499, atol=1e-5, rtol=1e-4)
    assert torch.equal(factor, factor.tril())
    assert (factor.diagonal() > 0).all()


def test_entries_that_depend_on_each_other_have_a_factor_too() -> None:
    """As a velocity that is a difference of positions; so do fewer steps than entries, and a single one."""
    torch.manual_seed(0)
    for seed in range(20):
        torch.manual_seed(seed)
        moved = 10 ** (seed / 4 - 3) * torch.randn(200, 2)
        residual = torch.cat([moved, moved / 0.1], dim=1)
        factor = scatter_factor(residual)
        expected = torch.cov(residual.T)
        torch.testing.assert_close(factor @ factor.T, expected, atol=2e-9, rtol=1e-3)
    few = torch.randn(5, 8)
    factor = scatter_factor(few)
    torch.testing.assert_close(factor @ factor.T, torch.cov(few.T), atol=1e-5, rtol=1e-3)
    assert float(scatter_factor(torch.randn(1, 3)).abs().max()) < 1e-4
    assert scatter_factor(torch.randn(9, 1)).shape == (1, 1)


def test_scatter_is_of_real_steps_between_the_raw_simulator_and_the_target() -> None:
    torch.manual_seed(0)
    state, error = torch.randn(2, 50, 4), 0.1 * torch.randn(2, 50, 4)
    error[1, 20:] = 1e3  # padding
    mask = torch.ones(2, 50)
    mask[1, 20:] = 0.0
    episodes = toy_episodes(
        state, torch.zeros(2, 50, 2), next_state=state + error, simulated_next=state, mask=mask
    )
    expected = scatter_factor(torch.cat([error[0], error[1, :20]]))
    torch.testing.assert_close(NO_GROUNDING.scatter(episodes), expected, atol=1e-5, rtol=1e-4)


def test_simulators_are_the_tasks_own() -> None:
    scatter = torch.eye(4)
    plain = NO_GROUNDING.simulator(TASK, 3, scatter=scatter)
    assert type(plain) is EpisodeSimulator and type(plain.simulator) is PointMass
    assert plain.scatter is scatter
    assert plain.state.shape == (3, 4)
    varied = NO_GROUNDING.simulator(TASK, 3, variation=TASK.varied.wide)
    assert isinstance(varied.simulator, VariedSimulator)


def test_nothing_is_remembered() -> None:
    episodes = toy_episodes(torch.zeros(1, 3, 4), torch.zeros(1, 3, 2), next_state=torch.zeros(1, 3, 4))
    grounding: Grounding = NO_GROUNDING
    assert grounding.hidden_before(episodes.windows) is None
    assert grounding.encoder is None
    assert NO_GROUNDING.for_replay() is NO_GROUNDING


def test_units_in_which_values_are_large_have_a_factor_too() -> None:
    torch.manual_seed(0)
    moved = 1e6 * torch.randn(200, 1)
    residual = torch.cat([moved, moved, 2 * moved], dim=1)
    factor = scatter_factor(residual)
    torch.testing.assert_close(factor @ factor.T, torch.cov(residual.T), rtol=1e-4, atol=0)
