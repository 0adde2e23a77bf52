"""Every part of the grounding model against the same numbers written out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from astra_data.grounding.encoder import take_scales
from astra_data.grounding.model import GroundingModel, GroundingShape, LossWeights
from astra_data.grounding.paired_episodes import PairedWindows

NOTHING = LossWeights(latent=0.0, reward=0.0, state=0.0)
EPISODES, STEPS = 3, 7


def windows() -> PairedWindows:
    """Two episodes that fail, and a step in their midst that only the simulator rewards."""
    generator = torch.Generator().manual_seed(0)

    def draw(*size: int) -> Tensor:
        return torch.randn(EPISODES, STEPS, *size, generator=generator)

    mask, failed = torch.ones(EPISODES, STEPS), torch.zeros(EPISODES, STEPS)
    mask[1, 4:] = 0.0
    failed[0, -1] = failed[1, 3] = 1.0
    goes_on = mask * (1.0 - failed)
    goes_on[2, 2] = 0.0
    return PairedWindows(
        state=draw(4),
        action=draw(2),
        previous_action=draw(2),
        goal=draw(2),
        simulated_next=draw(4),
        next_state=draw(4),
        reward=draw() - 9.0 * failed + 1e3 * (1.0 - mask),
        goes_on=goes_on,
        failed=failed,
        fails_soon=(draw() > 0).float(),
        mask=mask,
        own_reward=draw(),
    )


def model(*, corrects_reward: bool = True) -> GroundingModel:
    torch.manual_seed(0)
    made = GroundingModel(GroundingShape(4, 2, 2, latent_size=8, head_sizes=(16,), corrects_reward=corrects_reward))
    given = windows()
    columns = {
        "state": 3.0 + 2.0 * given.state,
        "goal": given.goal - 1.0,
        "correction": 0.5 * (given.next_state - given.simulated_next),
    }
    take_scales(made, {name: values.flatten(0, 1) for name, values in columns.items()})
    real = given.mask.bool()
    rewards = both_rewards(given) if corrects_reward else given.reward.unsqueeze(-1)
    made.set_reward_scales(rewards[real], given.goes_on[real], given.failed[real])
    list(made.correction.parameters())[-2].data.normal_(std=0.2)
    return made


def both_rewards(given: PairedWindows) -> Tensor:
    """Return the rewards and the residual ones, (E, T, 2)."""
    assert given.own_reward is not None
    return torch.stack([given.reward, given.reward - given.own_reward], dim=-1)


def real(values: Tensor) -> Tensor:
    """Return the mean of `values` (E, T) over real steps."""
    return values[windows().mask.bool()].mean()


def latents(used: GroundingModel) -> Tensor:
    given = windows()
    latent: Tensor = used.encoder(used.encoder_input(given.state, given.goal, given.previous_action))[0]
    return latent


def test_scales_are_means_and_deviations_of_the_columns() -> None:
    used, given = model(), windows()
    state, goal = (3.0 + 2.0 * given.state).flatten(0, 1), (given.goal - 1.0).flatten(0, 1)
    torch.testing.assert_close(used.state_mean, state.mean(0))
    torch.testing.assert_close(used.state_std, state.std(0))
    torch.testing.assert_close(used.goal_mean, goal.mean(0))
    take_scales(used, {"state": torch.ones(5, 4), "goal": torch.zeros(5, 0)})
    assert used.state_std.tolist() == pytest.approx([1e-3] * 4)
    torch.testing.assert_close(used.goal_std, goal.std(0))  # no goals: nothing to take


def test_reward_scales_are_those_of_what_is_learned_and_failures_never_pay() -> None:
    used = GroundingModel(GroundingShape(4, 2, 2, latent_size=8))
    reward = torch.tensor([1.0, 2.0, 3.0, 6.0, -12.0, -8.0, 99.0])
    known, failed = torch.tensor([1.0] * 4 + [0.0] * 3), torch.tensor([0.0] * 4 + [1.0] * 2 + [0.0])
    both = torch.stack([10 * reward, reward], dim=-1)
    used.set_reward_scales(both, known, failed)
    assert used.reward_mean.tolist() == pytest.approx([30.0, 3.0])
    assert used.reward_std.tolist() == pytest.approx([10 * 3.5**0.5, 3.5**0.5])  # (4 + 1 + 0 + 9) / 4
    assert float(used.failure_cost) == pytest.approx(-10.0 - 3.0)
    used.set_reward_scales(both, torch.zeros(7), torch.zeros(7))
    assert (float(used.reward_mean[1]), float(used.failure_cost)) == (3.0, -13.0)  # nothing to take
    used.set_reward_scales(torch.tensor([[1.0, 1.0], [1.0, 1.0], [5.0, 5.0]]), known[2:5], failed[2:5])
    assert (float(used.reward_mean[1]), float(used.failure_cost)) == (1.0, 0.0)
    assert used.reward_std.tolist() == pytest.approx([1e-3] * 2)


@pytest.mark.parametrize("corrects_reward", [False, True])
def test_rewards_are_predicted_in_the_units_of_the_data(corrects_reward: bool) -> None:
    used, latent, action = model(corrects_reward=corrects_reward), torch.randn(5, 8), torch.randn(5, 2)
    output = used.reward_head(torch.cat([latent, action], dim=-1))[:, -1]
    used.reward_shrinkage.fill_(0.3)
    predicted = 0.3 * (output * used.reward_std[-1] + used.reward_mean[-1])
    torch.testing.assert_close(used.predict_reward(latent, action), predicted)
    own, hazard = torch.randn(5), torch.rand(5)
    expected = predicted + own if corrects_reward else predicted
    torch.testing.assert_close(used.target_reward(latent, action, own), expected)
    assert float(used.failure_cost) < -5
    expected = expected + hazard * used.failure_cost
    torch.testing.assert_close(used.target_reward(latent, action, own, hazard), expected)


@pytest.mark.parametrize(("factor", "noise"), [(0.0, 1.0), (0.4, 0.0), (0.6, 0.5), (3.0, 0.1), (-1.0, 0.0)])
def test_predicted_rewards_shrink_to_what_they_explain(factor: float, noise: float) -> None:
    """By numpy: the slope, through the origin, of recorded on predicted rewards that are learned."""
    used, given = model().requires_grad_(False), windows()
    used.reward_shrinkage.fill_(0.7)  # of an earlier call
    output = used.reward_head(torch.cat([latents(used), given.action], dim=-1))[..., 1]
    predicted = output * used.reward_std[1] + used.reward_mean[1]
    known, torch_noise = given.goes_on.bool(), torch.randn(EPISODES, STEPS)
    recorded = torch.where(known, factor * predicted + noise * torch_noise, 1e3)
    assert given.own_reward is not None
    used.shrink_reward(replace(given, reward=recorded + given.own_reward))
    (slope,), *_ = np.linalg.lstsq(predicted[known].numpy()[:, None], recorded[known].numpy(), rcond=None)
    assert float(used.reward_shrinkage) == pytest.approx(min(max(slope, 0.0), 1.0), abs=1e-5)


def test_a_correction_is_added_in_the_units_of_the_data() -> None:
    used, latent, action, landed = model(), torch.randn(5, 8), torch.randn(5, 2), torch.randn(5, 4)
    inputs = torch.cat([latent, action, used.state_features(landed)], dim=-1)
    expected = landed + used.correction(inputs) * used.correction_std
    torch.testing.assert_close(used.correction_inputs(latent, action, landed), inputs)
    torch.testing.assert_close(used.correct(latent, action, landed), expected)
    assert (expected - landed).abs().max() > 1e-3


def test_the_loss_of_the_correction_is_its_squared_error_in_units_of_the_data() -> None:
    used, given = model(), windows()
    corrected = used.correct(latents(used), given.action, given.simulated_next)
    error = ((corrected - given.next_state) / used.correction_std).square().mean(-1)
    _, parts = used.losses(given, NOTHING)
    torch.testing.assert_close(parts["state"], real(error))


def test_the_loss_of_the_reward_is_of_steps_whose_reward_is_learned() -> None:
    used, given = model().requires_grad_(False), windows()
    output = used.reward_head(torch.cat([latents(used), given.action], dim=-1))
    error = (output - (both_rewards(given) - used.reward_mean) / used.reward_std).square().sum(-1)
    weights = LossWeights(latent=0.0)
    expected = 0.5 * error[given.goes_on.bool()].mean()
    torch.testing.assert_close(used.losses(given, weights)[1]["reward"], expected)
    other = replace(given, reward=torch.where(given.goes_on.bool(), given.reward, 50.0))
    torch.testing.assert_close(used.losses(other, weights)[1]["reward"], expected)
    none = replace(given, goes_on=torch.zeros(EPISODES, STEPS))
    assert float(used.losses(none, weights)[1]["reward"]) == 0.0
    last = list(used.reward_head.parameters())
    for parameter in last[-2:]:
        parameter.data.zero_()
    # What predicts the means loses a half for each.
    assert float(used.losses(given, weights)[1]["reward"]) == pytest.approx(1.0, rel=1e-4)


def test_the_latent_loss_follows_the_slow_encoder() -> None:
    used, given = model(), windows()
    with torch.no_grad():
        for parameter in used.target_encoder.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    slow, _ = used.target_encoder.sequence(used.encoder_input(given.state, given.goal, given.previous_action))
    mean, log_variance = used.predict_latent(latents(used)[:, :-1], given.action[:, :-1])
    likelihood = torch.distributions.Normal(mean, (0.5 * log_variance).exp()).log_prob(slow[:, 1:]).mean(-1)
    both = (given.mask[:, :-1] * given.mask[:, 1:]).bool()
    _, parts = used.losses(given, LossWeights())
    expected = -likelihood[both].mean() - 0.5 * math.log(2 * math.pi)
    torch.testing.assert_close(parts["latent"], expected)


def test_the_target_of_the_latent_loss_gives_no_gradient() -> None:
    used, given = model(), windows()
    for parameter in used.latent_dynamics.parameters():  # predictions without a gradient to the latents
        parameter.data.zero_()
    used.losses(given, replace(NOTHING, latent=1.0))[0].backward()
    gradient = next(used.encoder.parameters()).grad
    assert gradient is None or not gradient.any()
