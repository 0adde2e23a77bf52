import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from toy_episodes import toy_episodes

from astra_data.core.errors import BadInputError
from astra_data.grounding.encoder import take_scales
from astra_data.grounding.model import GroundingModel, GroundingShape, LossWeights, correction_r2, telemetry
from astra_data.grounding.paired_episodes import PairedEpisodes, PairedWindows

SIZE = 16


def lagging_world(episodes: int, steps: int, seed: int) -> PairedWindows:
    """Return episodes in which the target is dragged along by a low-pass of past actions."""
    generator = torch.Generator().manual_seed(seed)
    action = torch.rand(episodes, steps, 2, generator=generator) * 2 - 1
    state, simulated = torch.zeros(episodes, steps + 1, 2), torch.zeros(episodes, steps, 2)
    drag = torch.zeros(episodes, 2)
    for step in range(steps):
        simulated[:, step] = state[:, step] + 0.1 * action[:, step]
        state[:, step + 1] = simulated[:, step] + 0.2 * drag
        drag = 0.7 * drag + 0.3 * action[:, step]
    after = state[:, 1:]
    paid = after.norm(dim=-1)
    return toy_episodes(state[:, :-1], action, next_state=after, simulated_next=simulated, reward=paid).windows


TRAINING, HELD_OUT = lagging_world(32, 30, seed=0), lagging_world(64, 30, seed=1)


def untrained() -> GroundingModel:
    torch.manual_seed(0)
    shape = GroundingShape(
        2, 2, 2, latent_size=SIZE, embedding_size=32, head_sizes=(32,), position_octaves=0, corrects_reward=False
    )
    model = GroundingModel(shape)
    columns = {"state": TRAINING.state, "goal": TRAINING.goal}
    columns["correction"] = TRAINING.next_state - TRAINING.simulated_next
    take_scales(model, {name: values.flatten(0, 1) for name, values in columns.items()})
    model.set_reward_scales(TRAINING.reward.reshape(-1, 1), TRAINING.goes_on.flatten(), TRAINING.failed.flatten())
    return model


WEIGHTS = LossWeights()


def fit(model: GroundingModel, updates: int = 130) -> float:
    """Train `model` by the loss of the latent alone, and return the last one."""
    optimizer, loss = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], lr=3e-3), torch.zeros(())
    for _ in range(updates):
        loss = model.losses(TRAINING, WEIGHTS)[1]["latent"]
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        model.update_target()
    return float(loss.detach())


@torch.no_grad()
def latents(model: GroundingModel) -> Tensor:
    latent, _ = model.encoder.sequence(model.encoder_input(HELD_OUT.state, HELD_OUT.goal, HELD_OUT.previous_action))
    return torch.as_tensor(latent)


def spread(model: GroundingModel) -> float:
    """Return the standard deviation of the latents' entries over held-out histories."""
    return float(latents(model).flatten(0, 1).std(0).mean())


def test_the_latents_loss_does_not_collapse_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """The LayerNorm fixes the length of each latent, but not that different histories differ in theirs.

    With an encoder that follows at once, all histories come to share one latent, and the loss falls to what
    the bounds of the predicted variance allow, having learned nothing.
    """
    lowest = 0.5 * GroundingShape(2, 2, 2).log_variance_bounds[0]
    slow, online = untrained(), untrained()
    monkeypatch.setattr(online, "_following_latent", lambda inputs: online.encoder.sequence(inputs)[0][:, 1:])
    assert fit(online) == pytest.approx(lowest, abs=0.1) and fit(slow) > lowest + 0.2
    assert spread(online) < 0.05 < 0.4 < spread(slow)


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
    columns = {"state": 3.0 + 2.0 * given.state, "goal": given.goal - 1.0}
    columns["correction"] = 0.5 * (given.next_state - given.simulated_next)
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


def latents_of(used: GroundingModel) -> Tensor:
    given = windows()
    latent: Tensor = used.encoder.sequence(used.encoder_input(given.state, given.goal, given.previous_action))[0]
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
    output = used.reward_head(torch.cat([latents_of(used), given.action], dim=-1))[..., 1]
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
    beside = GroundingModel(GroundingShape(6, 2, 2, latent_size=8, position_octaves=0, ball_index=4))
    beside.state_mean.fill_(1.0)
    near = beside.state_features(torch.tensor([1.0, 2.0, 0.0, 0.0, 1.03, 1.96])).tolist()
    assert near == pytest.approx([0.0, 1.0, -1.0, -1.0, 0.03, 0.96, 0.3, -0.4, 0.5], abs=1e-4)  # of the ball, in 0.1 m


def test_the_loss_of_the_correction_is_its_squared_error_in_units_of_the_data() -> None:
    used, given = model(), windows()
    corrected = used.correct(latents_of(used), given.action, given.simulated_next)
    error = ((corrected - given.next_state) / used.correction_std).square().mean(-1)
    _, parts = used.losses(given, WEIGHTS)
    torch.testing.assert_close(parts["state"], real(error))


def test_the_loss_of_the_reward_is_of_steps_whose_reward_is_learned() -> None:
    used, given = model().requires_grad_(False), windows()
    output = used.reward_head(torch.cat([latents_of(used), given.action], dim=-1))
    error = (output - (both_rewards(given) - used.reward_mean) / used.reward_std).square().sum(-1)
    weights = LossWeights(latent=0.0)
    expected = 0.5 * error[given.goes_on.bool()].mean()
    torch.testing.assert_close(used.losses(given, weights)[1]["reward"], expected)
    other = replace(given, reward=torch.where(given.goes_on.bool(), given.reward, 50.0))
    torch.testing.assert_close(used.losses(other, weights)[1]["reward"], expected)
    none = replace(given, goes_on=torch.zeros(EPISODES, STEPS))
    assert float(used.losses(none, weights)[1]["reward"]) == 0.0
    drawn = replace(given, mask=given.mask * (torch.arange(STEPS) > 0))
    expected = 0.5 * error[(given.goes_on * drawn.mask).bool()].mean()
    torch.testing.assert_close(used.losses(drawn, weights)[1]["reward"], expected)
    for parameter in list(used.reward_head.parameters())[-2:]:
        parameter.data.zero_()
    # What predicts the means loses a half for each.
    assert float(used.losses(given, weights)[1]["reward"]) == pytest.approx(1.0, rel=1e-4)


def test_the_latent_loss_follows_the_slow_encoder() -> None:
    used, given = model(), windows()
    with torch.no_grad():
        for parameter in used.target_encoder.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    slow, _ = used.target_encoder.sequence(used.encoder_input(given.state, given.goal, given.previous_action))
    mean, log_variance = used.predict_latent(latents_of(used)[:, :-1], given.action[:, :-1])
    likelihood = torch.distributions.Normal(mean, (0.5 * log_variance).exp()).log_prob(slow[:, 1:]).mean(-1)
    both = (given.mask[:, :-1] * given.mask[:, 1:]).bool()
    _, parts = used.losses(given, WEIGHTS)
    expected = -likelihood[both].mean() - 0.5 * math.log(2 * math.pi)
    torch.testing.assert_close(parts["latent"], expected)
    before = [parameter.clone() for parameter in used.target_encoder.parameters()]
    used.update_target()
    followed = zip(used.target_encoder.parameters(), before, used.encoder.parameters(), strict=True)
    for after, was, fast in followed:
        torch.testing.assert_close(after, 0.99 * was + 0.01 * fast.detach())


def test_the_target_of_the_latent_loss_gives_no_gradient() -> None:
    used, given = model(), windows()
    for parameter in used.latent_dynamics.parameters():  # predictions without a gradient to the latents
        parameter.data.zero_()
    assert (used.predict_latent(torch.zeros(3, 8), torch.zeros(3, 2))[1] == -2.0).all()  # midway of the bounds
    used.losses(given, WEIGHTS)[1]["latent"].backward()
    gradient = next(used.encoder.parameters()).grad
    assert gradient is None or not gradient.any()


def episodes() -> PairedEpisodes:
    """Return four episodes of 12 steps; the last has only 7, and other numbers in its padding.

    The first and the last fail, the second succeeds.
    """
    torch.manual_seed(0)
    state, error = torch.randn(4, 12, 4), 0.1 * torch.randn(4, 12, 4)
    mask = torch.ones(4, 12)
    mask[3, 7:] = 0.0
    failed = torch.zeros(4, 12)
    failed[0, -1] = failed[3, 6] = 1.0
    reward = torch.randn(4, 12) - 9.0 * failed
    ended = failed.bool()
    ended[1, -1], reward[1, -1] = True, 40.0
    spoiled = 1e3 * (1.0 - mask).unsqueeze(-1)
    return toy_episodes(
        state,
        torch.randn(4, 12, 2),
        next_state=state + error + spoiled,
        simulated_next=state,
        goal=torch.randn(4, 12, 2),
        mask=mask,
        reward=reward + spoiled[..., 0],
        failed=failed,
        terminated=ended,
    )


def model_of(given: PairedEpisodes) -> GroundingModel:
    torch.manual_seed(1)
    shape = GroundingShape(4, 2, 2, latent_size=6, head_sizes=(8,), position_octaves=0, corrects_reward=False)
    made, windows = GroundingModel(shape), given.windows
    made.set_reward_scales(*map(given.steps, (windows.reward[..., None], windows.goes_on, windows.failed)))
    list(made.correction.parameters())[-2].data.normal_(std=0.05)
    return made.requires_grad_(False)


def r2(predicted: torch.Tensor, true: torch.Tensor) -> float:
    return float(1.0 - (predicted - true).square().sum() / (true - true.mean(0)).square().sum())


def test_shares_of_variance_are_those_of_real_steps() -> None:
    given = episodes()
    used, windows, real = model_of(given), given.windows, given.windows.mask.bool()
    figures = telemetry(used, given, WEIGHTS)
    latent, _ = used.encode(windows)
    predicted, reward = used.target_reward(latent, windows.action, torch.zeros(())), windows.reward
    paid = real & (reward > -5.0) & (reward < 40.0)
    assert int(real.sum() - paid.sum()) == 3
    assert figures["r2_reward"] == pytest.approx(r2(predicted[paid], reward[paid]), rel=1e-4)
    mean, _ = used.predict_latent(latent[:, :-1], windows.action[:, :-1])
    both = real[:, 1:]
    assert figures["r2_latent"] == pytest.approx(r2(mean[both], latent[:, 1:][both]), rel=1e-4)
    corrected = used.correct(latent, windows.action, windows.simulated_next)
    assert figures["r2_state"] == correction_r2(corrected, windows, used)
    two = GroundingModel(GroundingShape(4, 2, 2, latent_size=6, head_sizes=(8,))).requires_grad_(False)
    whole = two.rewards(two.encode(windows)[0], windows.action)[paid][:, 0]  # not the residual
    residual = replace(given, windows=replace(windows, own_reward=torch.randn(4, 12)))
    assert telemetry(two, residual, WEIGHTS)["r2_reward"] == pytest.approx(r2(whole, reward[paid]), rel=1e-4)


def test_a_fit_that_diverged_is_told() -> None:
    used = model_of(episodes())
    next(used.encoder.parameters()).data.fill_(torch.nan)
    with pytest.raises(BadInputError, match=r"the fit diverged: lower learning_rate in \[ground\]"):
        telemetry(used, episodes(), WEIGHTS)
