"""The scatter model: what a correction leaves unexplained, by the moment."""

import math
from collections.abc import Iterator

import pytest
import torch
from grounding_models import HERE
from torch.distributions import Normal
from toy_episodes import toy_episodes

from astra_data.grounding.descent import DescentConfig
from astra_data.grounding.history import HistoryGrounding, ScatterModel, ScatterShape, fit_scatter
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.simulator import EpisodeSimulator
from astra_data.robots.registry import TASKS

TASK = TASKS["antmaze-umaze"]
CALM, WILD = 0.01, 0.05
MASKED = 7


def grounding_model() -> GroundingModel:
    torch.manual_seed(0)
    return GroundingModel(GroundingShape(4, 2, 2, latent_size=8)).requires_grad_(False).eval()


def scattered_episodes(seed: int, episodes: int = 30) -> PairedEpisodes:
    """Robots that scatter little around the simulator, and much where they are told to go right."""
    torch.manual_seed(seed)
    state = torch.tensor([0.0, 4.0, 0.0, 0.0]) + 0.1 * torch.randn(episodes, 50, 4)
    action = torch.rand(episodes, 50, 2)
    action[..., 0] = (0.5 + 0.5 * action[..., 0]) * (2 * torch.randint(2, (episodes, 50)) - 1)
    scale = torch.where(action[..., :1] > 0, WILD, CALM)
    mask = torch.ones(episodes, 50)
    mask[:, -MASKED:] = 0.0
    residual = scale * torch.randn(episodes, 50, 4) + 1e3 * (1 - mask)[..., None]
    return toy_episodes(state, action, simulated_next=state, next_state=state + residual, mask=mask)


@pytest.fixture(scope="module")
def brisk() -> Iterator[None]:
    """Fit in fewer updates, each of which goes farther."""
    with pytest.MonkeyPatch.context() as patch:
        settings = DescentConfig(updates=300, learning_rate=3e-3)
        patch.setattr("astra_data.grounding.history._DESCENT", settings)
        yield


@pytest.fixture(scope="module")
def fitted(brisk: None) -> tuple[ScatterModel, dict[str, float]]:
    return fit_scatter(grounding_model(), scattered_episodes(0), scattered_episodes(1), seed=0)


def test_the_scale_is_told_by_the_moment_and_the_forms_are_those_of_held_out_steps(
    fitted: tuple[ScatterModel, dict[str, float]],
) -> None:
    scatters, figures = fitted
    model, fresh = grounding_model(), scattered_episodes(2)
    windows = fresh.windows
    latent, _ = model.encode(windows)
    inputs = fresh.steps(model.correction_inputs(latent, windows.action, windows.simulated_next))
    right = fresh.steps(windows.action)[:, 0] > 0
    drawn = scatters.draw(inputs)
    assert float(drawn[right].std()) == pytest.approx(WILD, rel=0.15)
    assert float(drawn[~right].std()) == pytest.approx(CALM, rel=0.3) and len(scatters.forms) == 30 * (50 - MASKED)
    assert float(scatters.forms.std()) == pytest.approx(1.0, abs=0.15)
    # Of a Gaussian whose size is one of two, against one of the average size: nats of each of four entries.
    usual = ((CALM**2 + WILD**2) / 2) ** 0.5
    gain = 4 * (torch.tensor(usual).log() - torch.tensor([CALM, WILD]).log().mean())
    assert figures["gain_nats"] == pytest.approx(float(gain), rel=0.15)
    assert figures["kurtosis"] == pytest.approx(3.0, abs=0.6)


def test_forms_are_drawn_from_the_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("astra_data.grounding.history._DESCENT", DescentConfig(updates=1, learning_rate=1e-9))
    monkeypatch.setattr("astra_data.grounding.history._MOST_FORMS", 100)
    given = grounding_model(), scattered_episodes(0, 4), scattered_episodes(1, 4)
    for exact in given[1:]:  # in the last entry, which does not scatter
        exact.windows.next_state[..., 3] = exact.windows.simulated_next[..., 3]
    (one, figures), (other, _) = (fit_scatter(*given, seed) for seed in (0, 1))
    assert len(one.forms) == 100 and (one.forms - other.forms).abs().max() > 0.1
    windows = given[2].windows
    power = given[2].steps(windows.next_state - windows.simulated_next)[:, :3].square()
    kurtosis = power.square().mean(0) / power.mean(0).square()
    assert figures["kurtosis"] == pytest.approx(float(kurtosis.mean()), rel=1e-4)
    assert figures["gain_nats"] == pytest.approx(0.0, abs=1e-4)


def even(size: float = 0.05) -> ScatterModel:
    """Return a model with two forms, to the left and to the right."""
    shape = grounding_model().shape
    inputs = shape.latent_size + 2 + 4 + grounding_model().position_features.size
    made = ScatterModel(ScatterShape(inputs, 4, 2)).requires_grad_(False).eval()
    made.forms[0, 0], made.forms[1, 0] = -size, size
    return made


def test_corrected_states_are_scattered_and_replays_are_not() -> None:
    grounding = HistoryGrounding(grounding_model(), scatter_model=even())
    worlds = [one.simulator(TASK, 64) for one in (grounding, grounding.for_replay())]
    for world in worlds:
        torch.manual_seed(0)
        world.start(torch.tensor([0.0, 4.0, 0.0, 0.0]).expand(64, 4), torch.arange(64), torch.zeros(64, 2))
    apart = worlds[0].step(torch.zeros(64, 2)) - worlds[1].step(torch.zeros(64, 2))
    assert sorted({round(value, 4) for value in apart[:, 0].tolist()}) == [-0.05, 0.05]
    assert apart[:, 1:].abs().max() < 1e-6


def test_where_touches_are_failures_they_are_those_of_the_correction() -> None:
    def beside_a_wall(push_m: float, *, fails_at_walls: bool) -> EpisodeSimulator:
        model = grounding_model()
        list(model.correction.parameters())[-1][0] = push_m
        world = HistoryGrounding(model, scatter_model=even(0.5), fails_at_walls=fails_at_walls).simulator(TASK, 64)
        world.start(torch.tensor([-5.7, 4.0, 0.0, 0.0]).expand(64, 4), torch.arange(64), torch.zeros(64, 2))
        world.step(torch.zeros(64, 2))
        return world

    scattered = beside_a_wall(0.0, fails_at_walls=False)
    assert torch.equal(scattered.blocked, scattered.state[:, 0] < -5.5) and 0 < scattered.blocked.sum() < 64
    assert not beside_a_wall(0.0, fails_at_walls=True).blocked.any()
    pushed = beside_a_wall(-0.5, fails_at_walls=True)
    assert pushed.blocked.all() and float(pushed.state[:, 0].max()) == pytest.approx(-5.2, abs=0.1)
    pushed.start(HERE, torch.tensor([3]), torch.zeros(1, 2))
    assert (~pushed.blocked).nonzero().tolist() == [[3]]


INPUTS = torch.tensor([[0.3, -1.2], [2.0, 0.5], [-0.4, 0.1]])


def scatter_model(forms: int = 4) -> ScatterModel:
    torch.manual_seed(1)
    made = ScatterModel(ScatterShape(2, 3, forms)).requires_grad_(False).eval()
    made.usual.copy_(torch.tensor([0.1, 1.0, 10.0]))
    made.forms.normal_()
    return made


def told(made: ScatterModel) -> ScatterModel:
    """Let each moment have its own scale."""
    list(made.network.parameters())[-2].normal_()
    return made


def test_the_likelihood_is_that_of_a_gaussian_but_for_a_constant() -> None:
    made = told(scatter_model())
    residual = torch.randn(3, 3) * made.usual
    gaussian = Normal(0.0, made.log_scale(INPUTS).exp()).log_prob(residual / made.usual)
    apart = made.nll(INPUTS, residual) + gaussian
    torch.testing.assert_close(apart, torch.full((3, 3), -0.5 * math.log(2 * math.pi)))


def test_what_is_drawn_are_forms_at_the_scale_of_the_moment() -> None:
    made = told(scatter_model())
    assert made.log_scale(INPUTS).std() > 0.1
    torch.manual_seed(0)
    drawn = made.draw(INPUTS.repeat(100, 1))
    in_units = made.in_units(INPUTS.repeat(100, 1), drawn)
    nearest = (in_units[:, None] - made.forms).abs().amax(-1)
    assert float(nearest.amin(1).max()) < 1e-5  # all entries are of one form
    list(made.network.parameters())[-2].zero_()
    list(made.network.parameters())[-1].fill_(4.0)
    assert float(made.log_scale(INPUTS).max()) == pytest.approx(2 * math.tanh(2))
    assert set(nearest.argmin(1).tolist()) == {0, 1, 2, 3}
