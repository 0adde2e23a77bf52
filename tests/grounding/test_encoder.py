import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from toy_episodes import no_episodes

from astra_data.core.errors import BadInputError
from astra_data.grounding.alignment import TargetEncoder, gaussian_mmd
from astra_data.grounding.encoder import HistoryEncoder, PositionFeatures, check_encoder, mlp
from astra_data.grounding.files import load_grounding, load_target_encoder, save_grounding, save_target_encoder
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.model import GroundingModel, GroundingShape
from astra_data.methods import add_method
from astra_data.policies.networks import ActorCritic, PolicyShape
from astra_data.policies.running_policy import RunningPolicy
from astra_data.robots.registry import TASKS
from astra_data.worlds.user_code import user_object

TRANSFORMER = f"{Path(__file__).parents[2]}/recipes/examples/methods/transformer.py:Transformer"


@pytest.fixture
def encoder() -> HistoryEncoder:
    torch.manual_seed(0)
    return HistoryEncoder(5, embedding_size=16, latent_size=32)


@pytest.mark.parametrize("kind", ["gru", "transformer"])
def test_step_by_step_is_the_whole_sequence(kind: str) -> None:
    torch.manual_seed(0)
    made = {"gru": HistoryEncoder, "transformer": user_object(TRANSFORMER)}[kind]
    encoder, inputs = made(5, embedding_size=16, latent_size=32), torch.randn(3, 20, 5)
    check_encoder(encoder, inputs)
    assert encoder.training


@pytest.mark.parametrize(
    ("sequence", "told"),
    [
        (lambda latents, memories: (1.01 * latents, memories), "sequence: expected the latents of step, got .* step 0"),
        (lambda latents, memories: (latents, memories + 0.01), "sequence: expected the memories of step, got others"),
        (
            lambda latents, memories: (latents[:, :, :9], memories),
            r"sequence: latents: expected shape .*, got \(3, 4, 9",
        ),
        (lambda latents, memories: (latents * torch.nan, memories), "sequence: latents: expected finite numbers"),
        (lambda latents, memories: latents, r"^HistoryEncoder, on inputs of shape \(3, 4, 5\), fails with V"),
    ],
)
def test_an_encoder_whose_sequence_is_not_its_steps_is_refused(
    encoder: HistoryEncoder, sequence: Any, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = encoder.sequence
    monkeypatch.setattr(encoder, "sequence", lambda inputs: sequence(*usual(inputs)))
    with pytest.raises(BadInputError, match=told):
        check_encoder(encoder, torch.randn(3, 4, 5))


@pytest.mark.usefixtures("forgotten_methods")
def test_another_encoder_grounds_aligns_and_acts(tmp_path: Path) -> None:
    add_method("astra_transformer", TRANSFORMER.replace(":Transformer", ":METHOD"))
    torch.manual_seed(0)
    shape = GroundingShape(4, 2, 2, latent_size=8, embedding_size=8, encoder="transformer")
    model = GroundingModel(shape)
    list(model.correction.parameters())[-1].data.fill_(0.1)
    save_grounding(tmp_path / "grounding", HistoryGrounding(model), no_episodes())
    grounding = load_grounding(tmp_path / "grounding")
    assert isinstance(grounding, HistoryGrounding) and grounding.model.shape == shape
    state, action, goal = torch.randn(2, 4), torch.rand(2, 2), torch.ones(2, 2)
    simulator = grounding.simulator(TASKS["antmaze-umaze"], 2)
    simulator.start(state, torch.arange(2), goal)
    states, actions = [simulator.state], [torch.zeros(2, 2)]
    for _ in range(3):
        states.append(simulator.step(action))
        actions.append(action)
    history = model.encoder_input(torch.stack(states, 1), goal[:, None].expand(2, 4, 2), torch.stack(actions, 1))
    torch.testing.assert_close(simulator.latent, model.encoder.sequence(history)[0][:, -1])
    encoder = TargetEncoder(29, 2, 2, embedding_size=8, latent_size=8, encoder="transformer")
    save_target_encoder(tmp_path / "encoder", encoder)
    policy = ActorCritic(PolicyShape(8 + 8, 2))
    running = RunningPolicy(TASKS["antmaze-umaze"], policy, model, load_target_encoder(tmp_path / "encoder"))
    running.start(2)
    first, second = (running.act(torch.ones(2, 29), goal) for _ in range(2))
    assert not torch.equal(first, second)  # it remembers


def test_latents_have_zero_mean_and_unit_variance(encoder: HistoryEncoder) -> None:
    latents, states = encoder.sequence(3.0 * torch.randn(4, 10, 5))
    torch.testing.assert_close(latents.mean(-1), torch.zeros(4, 10), atol=1e-5, rtol=0)
    torch.testing.assert_close(latents.var(-1, unbiased=False), torch.ones(4, 10), atol=0.02, rtol=0)
    # The length of the hidden state is gone from the latent, which is what the LayerNorm is for.
    torch.testing.assert_close(encoder.latent(100.0 * states), latents, atol=0.02, rtol=0)


def test_position_features_have_halving_wavelengths() -> None:
    features = PositionFeatures(3)
    values = features(torch.tensor([[1.5, -2.0]]))[0].tolist()
    phases = [2 * math.pi * place / wavelength for place in (1.5, -2.0) for wavelength in (16, 8, 4)]
    assert len(values) == features.size == 12
    assert values == pytest.approx([math.sin(p) for p in phases] + [math.cos(p) for p in phases], abs=1e-6)


def test_a_step_is_that_of_a_gru_written_out(encoder: HistoryEncoder) -> None:
    """Cho et al. 2014: gates r and z, candidate n, h' = (1 - z) n + z h; the input is embedded with ELU."""
    inputs, hidden = torch.randn(3, 5), torch.randn(3, 32)
    embedded = inputs @ encoder.embedding.weight.T + encoder.embedding.bias
    embedded = torch.where(embedded > 0, embedded, embedded.exp() - 1.0)
    gru = dict(encoder.recurrence.named_parameters())
    of_input = (embedded @ gru["weight_ih_l0"].T + gru["bias_ih_l0"]).split(32, dim=-1)
    of_hidden = (hidden @ gru["weight_hh_l0"].T + gru["bias_hh_l0"]).split(32, dim=-1)
    reset, update = ((of_input[i] + of_hidden[i]).sigmoid() for i in (0, 1))
    candidate = torch.tanh(of_input[2] + reset * of_hidden[2])
    expected = (1.0 - update) * candidate + update * hidden
    torch.testing.assert_close(encoder.step(inputs, hidden), expected, atol=1e-6, rtol=1e-5)


def test_episodes_in_one_sequence_do_not_touch(encoder: HistoryEncoder) -> None:
    inputs, hidden, start = torch.randn(2, 6, 5), torch.randn(2, 32), torch.zeros(2, 6)
    start[0, 4] = start[1, 0] = 1.0
    states = encoder.through_episodes(inputs, hidden, start)
    torch.testing.assert_close(states[:1, 0], encoder.step(inputs[:1, 0], hidden[:1]))
    torch.testing.assert_close(states[:1, 4:], encoder.sequence(inputs[:1, 4:])[1])
    torch.testing.assert_close(states[1:], encoder.sequence(inputs[1:])[1])
    with torch.no_grad():
        torch.testing.assert_close(encoder.through_episodes(inputs, hidden, start), states)


def test_gradients_are_those_of_steps_one_after_another(encoder: HistoryEncoder) -> None:
    encoder = encoder.double()
    inputs, hidden = torch.randn(3, 6, 5).double(), torch.randn(3, 32).double()
    start = torch.zeros(3, 6).double()
    start[0, 3] = start[1, 0] = 1.0
    weights = torch.randn(3, 6, 32).double()

    def step_by_step(inputs: torch.Tensor, hidden: torch.Tensor) -> torch.Tensor:
        states = []
        for step in range(6):
            hidden = encoder.step(inputs[:, step], hidden * (1.0 - start[:, step : step + 1]))
            states.append(hidden)
        return torch.stack(states, dim=1)

    def gradients(states_of: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> list[torch.Tensor]:
        given = inputs.clone().requires_grad_(), hidden.clone().requires_grad_()
        loss = (states_of(*given).sin() * weights).sum()
        return [loss, *torch.autograd.grad(loss, [*given, *encoder.parameters()])]

    found = gradients(lambda inputs, hidden: encoder.through_episodes(inputs, hidden, start))
    torch.testing.assert_close(found, gradients(step_by_step))
    assert all(gradient.abs().max() > 0 for gradient in found)


def test_an_mlp_has_activations_between_its_layers_alone() -> None:
    network = mlp((3, 4, 5, 2), torch.nn.ReLU)
    assert [type(layer).__name__ for layer in network] == ["Linear", "ReLU", "Linear", "ReLU", "Linear"]
    sizes = [(layer.in_features, layer.out_features) for layer in network if isinstance(layer, torch.nn.Linear)]
    assert sizes == [(3, 4), (4, 5), (5, 2)]


def mean_kernel(x: Tensor, y: Tensor, bandwidths: Tensor) -> tuple[float, float]:
    """Return the mean of the kernel over pairs of samples (N, Z), and its standard error."""
    squared = (x - y).square().sum(-1, keepdim=True)
    values = (-squared / (2 * bandwidths.square())).exp().mean(-1)
    return float(values.mean()), float(values.std()) / len(x) ** 0.5


def test_closed_form_agrees_with_sampling() -> None:
    torch.manual_seed(0)
    bandwidths = torch.tensor([0.8, 2.5])
    means, variances = torch.randn(2, 6), 0.2 + torch.rand(2, 6)

    def samples(which: int) -> Tensor:
        return means[which] + variances[which].sqrt() * torch.randn(200_000, 6)

    terms = [(1, 0, 0), (1, 1, 1), (-2, 0, 1)]
    parts = [(sign, *mean_kernel(samples(i), samples(j), bandwidths)) for sign, i, j in terms]
    sampled = sum(sign * mean for sign, mean, _ in parts)
    error = sum((sign * error) ** 2 for sign, _, error in parts) ** 0.5
    exact = float(gaussian_mmd(means[0], variances[0], means[1], variances[1], bandwidths))
    assert abs(exact - sampled) < 4 * error
    assert exact > 20 * error  # the comparison above can tell something


def test_target_encoder_clips_normalized_states() -> None:
    encoder = TargetEncoder(3, 2, 1, embedding_size=4, latent_size=4, position_octaves=2)
    state, goal = 2.0 + 3.0 * torch.randn(5000, 3), torch.randn(5000, 2)
    encoder.set_scales(state, goal)
    inputs = encoder.encoder_input(state, goal, torch.zeros(5000, 1))
    assert inputs.shape == (5000, 6 + 8)
    torch.testing.assert_close(inputs[:, 3:11], PositionFeatures(2)(state[:, :2]))
    torch.testing.assert_close(inputs[:, :3].std(0), torch.ones(3), atol=0.01, rtol=0)
    far = encoder.encoder_input(torch.full((1, 3), 1e6), goal[:1] - 1e6, torch.zeros(1, 1))
    assert far[0, :3].tolist() == pytest.approx([5.0] * 3) and far[0, 11:13].tolist() == [-5.0] * 2
    encoder.set_scales(state[:1], goal[:1])  # one step has no deviation
    assert encoder.state_std.tolist() == pytest.approx([1e-3] * 3)


def test_target_encoder_does_not_see_what_it_shall_not() -> None:
    encoder = TargetEncoder(3, 0, 1, embedding_size=4, latent_size=4, position_octaves=0)
    state, nothing = torch.randn(50, 3), torch.zeros(50, 0)
    encoder.set_scales(state, nothing, unseen=[0, 2])
    inputs = encoder.encoder_input(1e6 * state, nothing, torch.zeros(50, 1))
    assert not inputs[:, [0, 2]].any() and inputs[:, 1].all()


@pytest.mark.parametrize(("r2", "deployed"), [(0.0, False), (0.89, False), (0.91, True)])
def test_only_a_close_target_encoder_is_deployed(r2: float, deployed: bool) -> None:
    encoder = TargetEncoder(3, 2, 1, embedding_size=4, latent_size=4)
    assert not encoder.is_deployed
    encoder.latent_r2.fill_(r2)
    again = TargetEncoder(**encoder.sizes)
    again.load_state_dict(encoder.state_dict())
    assert encoder.is_deployed is again.is_deployed is deployed
