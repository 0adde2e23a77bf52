"""On a world whose error in simulation depends on the actions of the past, which no single state shows."""

from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from astra_data.learning.networks.grounding import GroundingModel, GroundingShape, LossWeights, TargetKind
from astra_data.learning.networks.paired_windows import PairedWindows

NAS = LossWeights(latent=0.0, reward=0.0, state=1.0)
LATENT_ALONE = LossWeights(latent=1.0, reward=0.0, state=0.0)
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
    return PairedWindows(
        state=state[:, :-1],
        action=action,
        previous_action=torch.cat([torch.zeros(episodes, 1, 2), action[:, :-1]], dim=1),
        goal=torch.zeros(episodes, steps, 2),
        simulated_next=simulated,
        next_state=state[:, 1:],
        reward=torch.stack([state[:, 1:].norm(dim=-1), torch.zeros(episodes, steps)], dim=-1),
        goes_on=torch.ones(episodes, steps),
        failed=torch.zeros(episodes, steps),
        fails_soon=torch.zeros(episodes, steps),
        mask=torch.ones(episodes, steps),
    )


def set_reward_scales(model: GroundingModel, windows: PairedWindows, failure_weight: float = 1.0) -> None:
    failed = windows.failed.flatten()
    model.set_reward_scales(windows.reward.flatten(0, 1), windows.goes_on.flatten(), failed, failure_weight)


TRAINING, HELD_OUT = lagging_world(32, 30, seed=0), lagging_world(64, 30, seed=1)


def untrained(target: TargetKind = "ema", heads: int = 1) -> GroundingModel:
    torch.manual_seed(0)
    sizes = {"latent_size": SIZE, "embedding_size": 32, "head_sizes": (32,), "position_octaves": 0}
    sizes |= {"correction_heads": heads}
    model = GroundingModel(GroundingShape(2, 2, 2, **sizes), target)  # type: ignore[arg-type]
    model.set_scales(
        {
            "state": TRAINING.state.flatten(0, 1),
            "goal": TRAINING.goal.flatten(0, 1),
            "correction": (TRAINING.next_state - TRAINING.simulated_next).flatten(0, 1),
        }
    )
    set_reward_scales(model, TRAINING)
    return model


def fit(model: GroundingModel, weights: LossWeights, updates: int = 130) -> float:
    """Train `model` and return the last loss of the latent, if it has one."""
    optimizer = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], lr=3e-3)
    parts: dict[str, Tensor] = {}
    for _ in range(updates):
        loss, parts = model.losses(TRAINING, weights)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        model.update_target(0.01)
    return float(parts.get("latent", torch.zeros(())).detach())


@torch.no_grad()
def latents(model: GroundingModel) -> Tensor:
    latent, _ = model.encoder(model.encoder_input(HELD_OUT.state, HELD_OUT.goal, HELD_OUT.previous_action))
    return torch.as_tensor(latent)


@torch.no_grad()
def error_left(model: GroundingModel) -> float:
    """Return the squared error of the corrected simulator relative to the raw one's, on held-out episodes."""
    corrected = model.correct(latents(model), HELD_OUT.action, HELD_OUT.simulated_next)
    raw = HELD_OUT.simulated_next - HELD_OUT.next_state
    return float((corrected - HELD_OUT.next_state).square().mean() / raw.square().mean())


def spread(model: GroundingModel) -> float:
    """Return the standard deviation of the latents' entries over held-out histories."""
    return float(latents(model).flatten(0, 1).std(0).mean())


def test_untrained_it_is_the_raw_simulator() -> None:
    corrected = untrained().correct(torch.randn(7, SIZE), torch.randn(7, 2), HELD_OUT.state[:7, 0])
    assert torch.equal(corrected, HELD_OUT.state[:7, 0])


def test_far_from_the_data_corrections_are_those_at_its_edge() -> None:
    model = untrained()
    for parameter in list(model.corrections.parameters())[-2:]:
        torch.nn.init.normal_(parameter)
    deviations = torch.tensor([[1.0], [5.0], [100.0]])
    states = model.state_mean + deviations * model.state_std
    latent, action = torch.randn(1, SIZE).expand(3, -1), torch.randn(1, 2).expand(3, -1)
    near, edge, far = (model.correct(latent, action, states) - states).detach()
    torch.testing.assert_close(far, edge, atol=1e-4, rtol=0)
    assert (near - edge).abs().max() > 0.01


def test_heads_agree_where_there_is_data_and_nowhere_else() -> None:
    model = untrained(heads=4)
    fit(model, NAS)
    assert error_left(model) < 0.05
    latent, action, landed = latents(model), HELD_OUT.action, HELD_OUT.simulated_next
    with torch.no_grad():
        predictions = model.ensemble_predictions(latent, action, landed)
        model.usual_disagreement.copy_(model.disagreement(predictions).mean())
        torch.testing.assert_close(predictions.mean(0), model.correct(latent, action, landed))
        assert float(model.disagreement(predictions).mean()) == pytest.approx(1.0)
        # The world is linear: far states and commands are not like any in the data.
        elsewhere = model.ensemble_predictions(
            latent, 4.0 * action, model.state_mean - 4.0 * model.state_std + 0 * landed
        )
        assert float(model.disagreement(elsewhere).mean()) > 3.0
        model.usual_disagreement.zero_()
        agreed = elsewhere[:1].expand_as(elsewhere)
        assert float(model.disagreement(agreed).abs().max()) == 0.0


def test_it_learns_what_only_the_history_tells() -> None:
    wrong = (HELD_OUT.next_state - HELD_OUT.simulated_next).flatten(0, 1)
    seen = torch.cat([HELD_OUT.state, HELD_OUT.action, torch.ones(64, 30, 1)], dim=-1).flatten(0, 1)
    solution = torch.linalg.lstsq(seen, wrong).solution
    without_history = float((seen @ solution - wrong).square().mean() / wrong.square().mean())
    model = untrained()
    assert error_left(model) == pytest.approx(1.0)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    fit(model, NAS)
    assert error_left(model) < 0.01 < 0.5 < without_history
    # With NAS's weights, nothing else is learned.
    after = model.state_dict()
    for name, value in before.items():
        if name.startswith(("latent_dynamics", "reward_head")):
            assert torch.equal(value, after[name]), name
    assert not torch.equal(before["encoder.embedding.weight"], after["encoder.embedding.weight"])


def test_all_heads_learn_together() -> None:
    model = untrained()
    fit(model, LossWeights())
    assert error_left(model) < 0.1
    with torch.no_grad():
        predicted = model.predict_reward(latents(model), HELD_OUT.action)
    unexplained = (predicted - HELD_OUT.reward[..., 0]).square().mean() / HELD_OUT.reward[..., 0].var()
    assert float(unexplained) < 0.2


def test_an_update_in_which_no_head_learns_is_no_update() -> None:
    """Of a single window, two heads draw no half in one of four updates."""
    model, alone = untrained(heads=2), lagging_world(1, 8, seed=2)
    torch.manual_seed(0)
    losses = [float(model.losses(alone, NAS)[1]["state"].detach()) for _ in range(40)]
    assert 0 < losses.count(0.0) < 20 and min(losses) == 0.0


def test_where_the_ball_lies_from_the_robot_is_seen_to_the_centimeter_and_not_from_afar() -> None:
    model = GroundingModel(GroundingShape(8, 2, 2, position_octaves=0, ball_index=4))
    state = torch.tensor([[1.0, 2.0, 0, 0, 1.03, 1.96, 0, 0], [1.0, 2.0, 0, 0, -4.0, 2.0, 0, 0]])
    seen = model.state_features(state)[:, -3:]
    torch.testing.assert_close(seen, torch.tensor([[0.3, -0.4, 0.5], [-5.0, 0.0, 5.0]]))


@pytest.mark.parametrize(("paid", "cost"), [(-10.0, -10.0), (0.5, -4.5)])
def test_failing_is_predicted_as_often_as_it_happens_and_never_pays(paid: float, cost: float) -> None:
    """Whoever walks to the right fails in a tenth of the steps, others never; going on pays 0 or 5."""
    torch.manual_seed(0)
    falls = (TRAINING.action[..., 0] > 0) & (torch.rand(TRAINING.mask.shape) < 0.1)
    going_on = (paid - cost) * ~falls
    reward = torch.stack([going_on, paid * falls], dim=-1)
    windows = replace(TRAINING, reward=reward, goes_on=(~falls).float(), failed=falls.float())
    model = untrained()
    set_reward_scales(model, windows)
    with torch.no_grad():
        start = model.predict_reward_parts(torch.zeros(1, SIZE), torch.zeros(1, 2))[0, 1]
    assert float(start) == pytest.approx(cost * float(falls.float().mean()), rel=0.5)
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    for _ in range(100):
        loss, _ = model.losses(windows, LossWeights(latent=0.0))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        parts = model.predict_reward_parts(latents(model), HELD_OUT.action)
        right = HELD_OUT.action[..., 0] > 0
        assert float(parts[right][:, 1].mean()) == pytest.approx(0.1 * cost, abs=0.03 * -cost)
        assert float(parts[~right][:, 1].mean()) == pytest.approx(0.0, abs=0.02 * -cost)
        anywhere, any_action = 100 * torch.randn(1000, SIZE), 100 * torch.randn(1000, 2)
        assert float(model.predict_reward_parts(anywhere, any_action)[:, 1].max()) <= 0.0


def failing(share: float) -> PairedWindows:
    """Return the training windows where `share` of the steps fail, whatever is done."""
    torch.manual_seed(0)
    fails = -10.0 * (torch.rand(TRAINING.mask.shape) < share)
    reward = torch.stack([torch.zeros_like(fails), fails], dim=-1)
    return replace(TRAINING, reward=reward, goes_on=(fails == 0).float(), failed=(fails != 0).float())


def test_failures_count_as_much_as_they_are_told_to() -> None:
    model, windows, losses = untrained(), failing(0.02), []
    for weight in (1.0, 0.1):
        set_reward_scales(model, windows, weight)
        with torch.no_grad():
            last_weight, last_bias = list(model.reward_head.parameters())[-2:]
            last_weight.zero_()
            last_bias[0] = 0.0
            losses.append(float(model.losses(windows, LossWeights())[1]["reward"]))
    # The average is predicted: the failures alone are left to lose, and they make up one half of the loss.
    assert losses == pytest.approx([0.5, 0.05], rel=1e-3)


def test_without_half_of_the_latent_chance_failures_are_not_learned_by_heart() -> None:
    windows = failing(0.02)
    failed = windows.reward[..., 1] != 0

    def learned(dropout: float) -> float:
        model = untrained()
        model.shape = replace(model.shape, reward_dropout=dropout)
        set_reward_scales(model, windows)
        optimizer = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], lr=3e-3)
        for _ in range(150):
            optimizer.zero_grad()
            model.losses(windows, LossWeights(latent=0.0))[0].backward()
            optimizer.step()
        with torch.no_grad():
            latent, _ = model.encoder(
                model.encoder_input(windows.state, windows.goal, windows.previous_action)
            )
            return float(model.predict_reward_parts(latent, windows.action)[failed][:, 1].mean())

    assert learned(0.5) > 0.5 * learned(0.0)  # both negative: what steps cost that failed by chance


def test_the_printed_latent_loss_collapses_and_a_slow_target_does_not() -> None:
    """The LayerNorm fixes the length of each latent, but not that different histories differ in theirs.

    With gradients through both sides ("online", as printed), all histories come to share one latent, and
    the loss falls to what the bounds of the predicted variance allow, having learned nothing.
    """
    lowest = 0.5 * GroundingShape(2, 2, 2).log_variance_bounds[0]
    online, slow = untrained("online"), untrained("ema")
    assert spread(online) > 0.4
    assert fit(online, LATENT_ALONE) == pytest.approx(lowest, abs=0.1)
    assert spread(online) < 0.05
    assert fit(slow, LATENT_ALONE) > lowest + 0.2
    assert spread(slow) > 0.4
    torch.testing.assert_close(latents(online).var(-1, unbiased=False), torch.ones(64, 30), atol=0.02, rtol=0)


def test_only_the_slow_target_gives_no_gradient() -> None:
    model = untrained("ema")
    fit(model, LossWeights(), updates=3)
    assert all(parameter.grad is None for parameter in model.target_encoder.parameters())
    fast = torch.cat([p.flatten() for p in model.encoder.parameters()])
    slow = torch.cat([p.flatten() for p in model.target_encoder.parameters()])
    model.update_target(0.25)
    moved = torch.cat([p.flatten() for p in model.target_encoder.parameters()])
    torch.testing.assert_close(moved, slow + 0.25 * (fast - slow))


def test_masked_steps_do_not_count() -> None:
    model = untrained()
    torch.nn.init.normal_(list(model.corrections.parameters())[-1])
    mask = TRAINING.mask.clone()
    mask[:, 20:] = 0.0
    cut = PairedWindows(**{name: values[:, :20] for name, values in vars(TRAINING).items()})
    spoiled = replace(TRAINING, mask=mask, reward=TRAINING.reward + 1e3 * (1 - mask).unsqueeze(-1))
    _, parts = model.losses(spoiled, LossWeights())
    _, expected = model.losses(cut, LossWeights())
    assert parts.keys() == expected.keys() == {"latent", "reward", "state", "topple"}
    for name, value in expected.items():
        torch.testing.assert_close(parts[name], value, msg=name)


def test_the_latent_loss_is_the_negative_log_likelihood() -> None:
    model = untrained("detach")
    _, parts = model.losses(TRAINING, LATENT_ALONE)
    latent, _ = model.encoder(model.encoder_input(TRAINING.state, TRAINING.goal, TRAINING.previous_action))
    mean, log_variance = model.predict_latent(latent[:, :-1], TRAINING.action[:, :-1])
    likelihood = torch.distributions.Normal(mean, (0.5 * log_variance).exp()).log_prob(latent[:, 1:])
    constant = 0.5 * torch.log(torch.tensor(2 * torch.pi))
    torch.testing.assert_close(parts["latent"], -likelihood.mean() - constant)


def test_a_window_without_two_steps_in_a_row_teaches_no_latent() -> None:
    model = untrained("detach")
    mask = torch.zeros_like(TRAINING.mask)
    mask[:, 3] = 1.0
    total, parts = model.losses(replace(TRAINING, mask=mask), LATENT_ALONE)
    assert parts["latent"] == 0.0 and bool(total.isfinite())


def test_nothing_is_made_on_another_device_than_the_models() -> None:
    """On "meta", which holds no values and refuses tensors of the CPU beside its own."""
    windows = lagging_world(3, 5, seed=0)
    columns = {field.name: getattr(windows, field.name).to("meta") for field in fields(windows)}
    model = GroundingModel(GroundingShape(state_size=2, action_size=2, goal_size=2)).to("meta")
    loss, _ = model.losses(replace(windows, **columns), LossWeights())
    loss.backward()
    assert loss.device.type == "meta"
    latent, _ = model.encode(replace(windows, **columns))
    assert (latent.device.type, latent.shape) == ("meta", (3, 5, 64))
