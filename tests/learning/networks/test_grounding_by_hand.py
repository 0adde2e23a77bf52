"""Every part of the grounding model against the same numbers written out by hand."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from astra_data.learning.networks.grounding import GroundingModel, GroundingShape, LossWeights, TargetKind
from astra_data.learning.networks.paired_windows import PairedWindows

NOTHING = LossWeights(latent=0.0, reward=0.0, state=0.0)
EPISODES, STEPS = 3, 7


def windows() -> PairedWindows:
    generator = torch.Generator().manual_seed(0)

    def draw(*size: int) -> Tensor:
        return torch.randn(EPISODES, STEPS, *size, generator=generator)

    mask = torch.ones(EPISODES, STEPS)
    mask[1, 4:] = 0.0
    failing = torch.zeros(EPISODES, STEPS)
    failing[0, -1], failing[1, 3] = -10.0, -8.0
    return PairedWindows(
        state=draw(4),
        action=draw(2),
        previous_action=draw(2),
        goal=draw(2),
        simulated_next=draw(4),
        next_state=draw(4),
        reward=torch.stack([draw() * (failing == 0), failing], dim=-1),
        goes_on=(failing == 0).float(),
        failed=(failing != 0).float(),
        fails_soon=(draw() > 0).float(),
        mask=mask,
    )


def model(heads: int = 1, target: TargetKind = "ema", dropout: float = 0.0) -> GroundingModel:
    torch.manual_seed(0)
    shape = GroundingShape(
        4, 2, 2, latent_size=8, head_sizes=(16,), correction_heads=heads, reward_dropout=dropout
    )
    made = GroundingModel(shape, target)
    given = windows()
    columns = {
        "state": 3.0 + 2.0 * given.state,
        "goal": given.goal - 1.0,
        "correction": 0.5 * (given.next_state - given.simulated_next),
    }
    made.set_scales({name: values.flatten(0, 1) for name, values in columns.items()})
    real = given.mask.bool()
    made.set_reward_scales(given.reward[real], given.goes_on[real], given.failed[real])
    with torch.no_grad():
        for head in made.corrections:
            list(head.parameters())[-2].normal_(std=0.2)
    return made


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
    used.set_scales({"state": torch.ones(5, 4), "goal": torch.zeros(5, 0)})
    assert used.state_std.tolist() == pytest.approx([1e-3] * 4)
    torch.testing.assert_close(used.goal_std, goal.std(0))  # no goals: nothing to take


def test_the_encoder_sees_state_places_goal_and_previous_action_in_this_order() -> None:
    used, given = model(), windows()
    inputs = used.encoder_input(given.state, given.goal, given.previous_action)
    normal = (given.state - used.state_mean) / used.state_std
    torch.testing.assert_close(inputs[..., :4], normal.clamp(-5.0, 5.0))
    torch.testing.assert_close(inputs[..., 4:20], used.position_features(given.state[..., :2]))
    torch.testing.assert_close(inputs[..., 20:22], (given.goal - used.goal_mean) / used.goal_std)
    far = used.encoder_input(given.state, given.goal + 1e3, given.previous_action)
    assert (far[..., 20:22] == 5.0).all()  # as of states, beyond what was seen
    assert torch.equal(inputs[..., 22:], given.previous_action)
    latent, hidden = used.encode(given)
    torch.testing.assert_close(latent, functional.layer_norm(hidden, (8,)))
    torch.testing.assert_close(latent, latents(used))


def test_reward_scales_are_those_of_steps_that_go_on() -> None:
    used = GroundingModel(GroundingShape(4, 2, 2, latent_size=8))
    going_on, failing = torch.tensor([1.0, 2.0, 3.0, 6.0, 0.0, 99.0]), torch.zeros(6)
    failing[4], goes_on = -12.0, torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0, 0.0])
    used.set_reward_scales(torch.stack([going_on, failing], dim=-1), goes_on, failing, failure_weight=2.0)
    assert float(used.reward_mean) == pytest.approx(3.0)
    assert float(used.reward_std) == pytest.approx(3.5**0.5)  # (4 + 1 + 0 + 9) / 4
    assert float(used.failure_cost) == pytest.approx(-12.0 - 3.0)
    entropy = -(math.log(1 / 6) / 6 + 5 * math.log(5 / 6) / 6)
    assert float(used.failure_weight) == pytest.approx(2.0 / entropy, rel=1e-5)
    bias = list(used.reward_head.parameters())[-1]
    assert float(bias[1].detach()) == pytest.approx(math.log((1 / 6) / (5 / 6)), rel=1e-5)


def test_failures_never_pay_and_are_taken_as_rare() -> None:
    used = GroundingModel(GroundingShape(4, 2, 2, latent_size=8))
    goes_on = torch.tensor([1.0, 0.0, 0.0, 0.0])
    paid = torch.tensor([[1.0, 0.0], [0.0, 5.0], [0.0, 5.0], [0.0, 5.0]])
    used.set_reward_scales(paid, goes_on, paid[:, 1])
    assert float(used.failure_cost) == 0.0
    assert float(used.failure_weight) == pytest.approx(1.0 / math.log(2.0), rel=1e-5)
    before = float(used.reward_mean)
    # All fail: nothing that goes on to scale by.
    used.set_reward_scales(torch.tensor([[0.0, -3.0]]), torch.zeros(1), torch.ones(1))
    assert (float(used.reward_mean), float(used.failure_cost)) == (before, -4.0)


def test_rewards_are_predicted_in_the_units_of_the_data() -> None:
    used, latent, action = model(), torch.randn(5, 8), torch.randn(5, 2)
    outputs = used.reward_head(torch.cat([latent, action], dim=-1))
    parts = used.predict_reward_parts(latent, action)
    torch.testing.assert_close(parts[:, 0], outputs[:, 0] * used.reward_std + used.reward_mean)
    torch.testing.assert_close(parts[:, 1], used.failure_cost / (1.0 + (-outputs[:, 1]).exp()))
    torch.testing.assert_close(used.predict_reward(latent, action), parts[:, 0] + parts[:, 1])


def test_variances_of_the_next_latent_keep_their_bounds() -> None:
    used = model()
    last = list(used.latent_dynamics.parameters())
    with torch.no_grad():
        last[-2].zero_()
        last[-1].copy_(torch.cat([torch.arange(8.0), torch.tensor([-50.0, 50.0, *[0.0] * 6])]))
    mean, log_variance = used.predict_latent(torch.randn(1, 8), torch.randn(1, 2))
    assert mean[0].tolist() == list(range(8))
    assert log_variance[0].tolist() == pytest.approx([-6.0, 2.0, *[-2.0] * 6])


def test_each_head_adds_its_correction_in_the_units_of_the_data() -> None:
    used, latent, action, landed = model(heads=3), torch.randn(5, 8), torch.randn(5, 2), torch.randn(5, 4)
    inputs = torch.cat([latent, action, used.state_features(landed)], dim=-1)
    expected = torch.stack([landed + head(inputs) * used.correction_std for head in used.corrections])
    torch.testing.assert_close(used.ensemble_predictions(latent, action, landed), expected)
    torch.testing.assert_close(used.correct(latent, action, landed), expected.sum(0) / 3)
    apart = expected[0] - expected[1]
    assert apart.abs().max() > 1e-3


def test_the_risk_of_a_topple_is_spread_over_the_steps_before_it() -> None:
    used, latent, action, after = model(), torch.randn(5, 8), torch.randn(5, 2), torch.randn(5, 4)
    logit = used.topple_head(torch.cat([latent, action, used.state_features(after)], dim=-1))[:, 0]
    torch.testing.assert_close(used.topple_risk(latent, action, after), 1.0 / (1.0 + (-logit).exp()) / 20)


def test_the_loss_of_the_correction_is_its_squared_error_in_units_of_the_data() -> None:
    used, given = model(), windows()
    corrected = used.correct(latents(used), given.action, given.simulated_next)
    error = ((corrected - given.next_state) / used.correction_std).square().mean(-1)
    _, parts = used.losses(given, NOTHING)
    torch.testing.assert_close(parts["state"], real(error))


def test_each_head_learns_from_its_own_half_of_the_windows() -> None:
    used, given = model(heads=4), windows()
    predictions = used.ensemble_predictions(latents(used), given.action, given.simulated_next)
    error = ((predictions - given.next_state) / used.correction_std).square().mean(-1)
    torch.manual_seed(3)
    drawn = torch.rand(4, EPISODES, 1) < 0.5
    assert 0 < drawn.sum() < drawn.numel()
    counted = drawn & given.mask.bool()
    torch.manual_seed(3)
    _, parts = used.losses(given, NOTHING)
    torch.testing.assert_close(parts["state"], error[counted].mean())


def test_failures_that_pay_nothing_are_failures() -> None:
    """As where every step pays 1 but that of the fall."""
    given = windows()
    given.reward[:], given.failed[:], given.goes_on[:] = torch.tensor([1.0, 0.0]), 0.0, given.mask
    given.goes_on[2, -1], given.failed[2, -1], given.reward[2, -1] = 0.0, 1.0, 0.0
    used, real = model(), given.mask.bool()
    used.set_reward_scales(given.reward[real], given.goes_on[real], given.failed[real])
    assert (float(used.reward_mean), float(used.failure_cost)) == (1.0, -1.0)
    known = used.losses(given, LossWeights())[1]["reward"]
    given.failed[:] = 0.0
    assert not torch.equal(known, used.losses(given, LossWeights())[1]["reward"])


def test_the_loss_of_the_reward_weighs_failures() -> None:
    used, given = model(), windows()
    outputs = used.reward_head(torch.cat([latents(used), given.action], dim=-1))
    reward, failing = given.reward.unbind(-1)
    fails = failing != 0
    normal = (reward - used.reward_mean) / used.reward_std
    of_rest = torch.where(fails, 0.0, (outputs[..., 0] - normal).square())
    probability = outputs[..., 1].sigmoid()
    surprise = -torch.where(fails, probability, 1.0 - probability).log()
    _, parts = used.losses(given, LossWeights(latent=0.0))
    torch.testing.assert_close(parts["reward"], 0.5 * real(of_rest + used.failure_weight * surprise))


def test_what_a_success_pays_counts_nowhere() -> None:
    """The last step of the third episode reaches the goal: neither scales nor losses know its reward."""
    found = []
    for paid in (0.0, 50.0):
        given = windows()
        given.goes_on[2, -1], given.reward[2, -1, 0] = 0.0, paid
        used, real_steps = model(), given.mask.bool()
        used.set_reward_scales(given.reward[real_steps], given.goes_on[real_steps], given.failed[real_steps])
        found.append((used.reward_mean, used.reward_std, used.losses(given, LossWeights())[0]))
    assert all(map(torch.equal, *found))


def test_the_latent_loss_follows_the_slow_encoder() -> None:
    used, given = model(), windows()
    with torch.no_grad():
        for parameter in used.target_encoder.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    slow, _ = used.target_encoder(used.encoder_input(given.state, given.goal, given.previous_action))
    mean, log_variance = used.predict_latent(latents(used)[:, :-1], given.action[:, :-1])
    likelihood = torch.distributions.Normal(mean, (0.5 * log_variance).exp()).log_prob(slow[:, 1:]).mean(-1)
    both = (given.mask[:, :-1] * given.mask[:, 1:]).bool()
    _, parts = used.losses(given, LossWeights())
    expected = -likelihood[both].mean() - 0.5 * math.log(2 * math.pi)
    torch.testing.assert_close(parts["latent"], expected)


@pytest.mark.parametrize(("target", "flows"), [("online", True), ("detach", False), ("ema", False)])
def test_the_target_of_the_latent_loss_gives_a_gradient_only_online(target: TargetKind, flows: bool) -> None:
    used, given = model(target=target), windows()
    with torch.no_grad():  # predictions without a gradient to the latents
        for parameter in used.latent_dynamics.parameters():
            parameter.zero_()
    used.losses(given, replace(NOTHING, latent=1.0))[0].backward()
    gradient = used.encoder.embedding.weight.grad
    assert gradient is not None
    assert bool(gradient.any()) is flows


def test_the_total_is_the_weighted_sum_and_the_topple_loss() -> None:
    used, given = model(), windows()
    total, parts = used.losses(given, LossWeights(latent=0.1, reward=2.0, state=3.0))
    expected = 0.1 * parts["latent"] + 2.0 * parts["reward"] + 3.0 * parts["state"] + parts["topple"]
    torch.testing.assert_close(total, expected)
    logit = used.topple_logit(latents(used), given.action, given.next_state)
    probability = logit.sigmoid()
    surprise = -torch.where(given.fails_soon > 0, probability, 1.0 - probability).log()
    torch.testing.assert_close(parts["topple"], real(surprise))


def test_the_topple_head_does_not_shape_the_latent() -> None:
    used = model()
    used.losses(windows(), NOTHING)[0].backward()
    assert all(parameter.grad is not None for parameter in used.topple_head.parameters())
    for name, parameter in used.encoder.named_parameters():
        assert parameter.grad is None or not parameter.grad.any(), name


def test_dropout_hides_the_latent_from_the_reward_head_in_training_alone() -> None:
    used, given = model(dropout=0.9), windows()
    weights = LossWeights(latent=0.0)
    plain = model().losses(given, weights)[1]
    trained = used.losses(given, weights)[1]
    evaluated = used.eval().losses(given, weights)[1]
    assert float(trained["reward"].detach()) != pytest.approx(float(plain["reward"].detach()), rel=1e-4)
    torch.testing.assert_close(trained["state"], plain["state"])
    torch.testing.assert_close(evaluated["reward"], plain["reward"])


def test_the_slow_encoder_starts_as_the_encoder_and_is_not_trained() -> None:
    used = model()
    pairs = list(zip(used.target_encoder.parameters(), used.encoder.parameters(), strict=True))
    assert all(torch.equal(slow, fast) for slow, fast in pairs)
    assert not any(slow.requires_grad for slow, _ in pairs) and all(fast.requires_grad for _, fast in pairs)
