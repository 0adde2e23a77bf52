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
    centred = residual - residual.mean(0)
    torch.testing.assert_close(factor @ factor.T, centred.T @ centred / 499, atol=1e-5, rtol=1e-4)
    assert torch.equal(factor, factor.tril())
    assert (factor.diagonal() > 0).all()


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
