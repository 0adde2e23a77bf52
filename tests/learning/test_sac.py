import copy
import math
from typing import Any

import pytest
import torch
from kept_states import came_back
from torch import nn
from toy_worlds import ConstantReward, EndsAtZero, GoToZero, Recall

from astra_data.core.errors import BadInputError
from astra_data.learning.networks.policy import PolicyShape, features_of
from astra_data.learning.networks.soft_actor import SoftActor
from astra_data.learning.recorded import Recorded
from astra_data.learning.sac import Sac, SacConfig
from astra_data.worlds.batched import BatchedEnv


def sac(
    env: BatchedEnv,
    steps: int,
    *,
    horizon: int,
    memory: int = 0,
    recorded: Recorded | None = None,
    **settings: Any,  # noqa: ANN401
) -> Sac:
    usual = {"rollout_steps": 10, "updates_per_step": 2, "batch_size": 64, "discount": 0.9}
    config = SacConfig(total_steps=steps * env.num_envs, **{**usual, **settings})
    torch.manual_seed(0)
    shape = PolicyShape(env.observation_size, env.action_size, memory, 16, (32, 32))
    return Sac(env, SoftActor(shape), config, horizon=horizon, seed=1, recorded=recorded)


def train(learner: Sac) -> list[dict[str, float]]:
    metrics = []
    while not learner.done:
        metrics.append(learner.iterate())
    return metrics


def distance_after(policy: SoftActor, steps: int) -> float:
    """Return how far from 0 the policy's likeliest action leaves points that start at ±1."""
    place, hidden = torch.tensor([[-1.0], [1.0]]), policy.initial_hidden(2)
    action = torch.zeros(2, 1)
    with torch.no_grad():
        for _ in range(steps):
            features, hidden = policy.remember(place, action, hidden)
            action = policy.act(features)
            place = (place + 0.2 * action).clamp(-1.0, 1.0)
    return float(place.abs().max())


@pytest.mark.parametrize("memory", [0, 8])
def test_learns_to_go_to_a_target(memory: int) -> None:
    settings: dict[str, Any] = {"window": 8, "burn_in": 2, "batch_size": 128, "updates_per_step": 3}
    learner = sac(GoToZero(16), 100, horizon=20, memory=memory, **settings)
    assert distance_after(learner.policy, 10) > 0.5
    metrics = train(learner)
    assert distance_after(learner.policy, 10) < 0.15
    assert learner.steps == 100 * 16
    assert metrics[-1]["reward"] > metrics[0]["reward"]


def test_the_second_half_learns_ever_more_slowly() -> None:
    one, other = (sac(GoToZero(8), steps, horizon=7) for steps in (40, 80))
    for alike in (True, True, True, False):
        one.iterate()
        other.iterate()
        pairs = zip(one.policy.parameters(), other.policy.parameters(), strict=True)
        assert all(torch.equal(*pair) for pair in pairs) == alike
    before = copy.deepcopy(other.policy)
    steps = []
    while not other.done:
        other.iterate()
        pairs = zip(before.parameters(), other.policy.parameters(), strict=True)
        steps.append(max(float((now - then).detach().abs().max()) for now, then in pairs))
        before = copy.deepcopy(other.policy)
    assert steps[-1] < 0.5 * steps[0]


@pytest.mark.parametrize("memory", [0, 8])
def test_resuming_gives_the_same_parameters_to_the_bit(memory: int) -> None:
    # The replay has wrapped around by then.
    settings: dict[str, Any] = {
        "horizon": 7,
        "memory": memory,
        "window": 6,
        "burn_in": 2,
        "buffer_size": 8 * 25,
        "updates_per_step": 1,
    }
    whole = sac(GoToZero(8), 60, **settings)
    train(whole)
    world, other_world = GoToZero(8), GoToZero(8)
    begun = sac(world, 60, **settings)
    for _ in range(3):
        begun.iterate()
    saved = came_back({"sac": begun.state_dict(), "world": world.state_dict()})
    resumed = sac(other_world, 60, **settings)
    resumed.load_state_dict(saved["sac"], other_world.load_state_dict(saved["world"]))
    assert resumed.steps == whole.steps / 2
    train(resumed)
    for name, value in whole.policy.state_dict().items():
        assert torch.equal(value, resumed.policy.state_dict()[name]), name


def test_where_the_episodes_cannot_go_on_its_replay_does_not_either() -> None:
    """The first step of the new ones doesn't follow the last one that was kept."""
    learner, again = (sac(GoToZero(4), 40, horizon=20) for _ in range(2))
    learner.iterate()
    again.load_state_dict(learner.state_dict(), again.env.reset(), goes_on=False)
    kept, cut = (torch.as_tensor(one.state_dict()["replay"]["expired"]) for one in (learner, again))
    assert torch.equal(cut[:-1], kept[:-1])
    assert cut[-1].all() and not kept[-1].any()


@pytest.mark.parametrize("memory", [0, 8])
def test_recorded_actions_are_imitated_where_rewards_leave_the_choice(memory: int) -> None:
    action = torch.full((4, 12, 1), 0.6)
    action[:, 9:] = -1.0  # after the end
    previous = torch.cat([torch.zeros(4, 1, 1), action[:, :-1]], dim=1)
    recorded = Recorded(torch.ones(4, 12, 1), previous, action, torch.full((4,), 9))
    settings: dict[str, Any] = {
        "horizon": 9,
        "memory": memory,
        "window": 6,
        "burn_in": 2,
        "imitation_weight": 1.0,
        "learning_rate": 3e-3,
    }
    learner = sac(ConstantReward(16, math.inf), 100, recorded=recorded, **settings)
    train(learner)
    with torch.no_grad():
        hidden = learner.policy.initial_hidden(1)
        features, _ = learner.policy.remember(torch.ones(1, 1), torch.zeros(1, 1), hidden)
        assert float(learner.policy.act(features)) == pytest.approx(0.6, abs=0.1)


@pytest.mark.parametrize(
    ("terminates_after", "memory", "expected"), [(math.inf, 0, 10.0), (math.inf, 8, 10.0), (10.0, 0, 5.26)]
)
def test_running_out_of_time_bootstraps_and_ending_does_not(
    terminates_after: float, memory: int, expected: float
) -> None:
    """One unit each step is worth 1 / (1 - 0.9) = 10; where a tenth of like steps are the last, 1 / 0.19."""
    horizon = 10 if terminates_after > 10 else 1000
    env = ConstantReward(16, terminates_after)
    learner = sac(
        *(env, 100),
        horizon=horizon,
        memory=memory,
        window=4,
        burn_in=1,
        target_rate=0.2,
        initial_temperature=1e-6,
        learning_rate=5e-3,
    )
    train(learner)
    begun = torch.ones(1, 1, 1), torch.zeros(1, 1, 1), torch.ones(1, 1)
    with torch.no_grad():
        features = learner._critics.features(*begun)[:, 0]
        value = float(learner._critics(features, torch.zeros(1, 1))[0])
    assert value == pytest.approx(expected, rel=0.12)


def test_a_window_begins_with_the_memory_that_the_policy_had_when_it_acted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    learner = sac(GoToZero(8), 40, horizon=9, memory=4, window=2, burn_in=0)
    policy = learner.policy
    acting, learning = policy.remember, policy.remember_sequence
    acted: dict[tuple[float, ...], list[float]] = {}
    begun: list[tuple[torch.Tensor, torch.Tensor]] = []

    def remember(
        observation: torch.Tensor, previous: torch.Tensor, hidden: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        for moment, memory in zip(torch.cat([observation, previous], dim=-1), hidden, strict=True):
            acted[tuple(moment.tolist())] = memory.tolist()
        return acting(observation, previous, hidden)

    def remember_sequence(
        observation: torch.Tensor, previous: torch.Tensor, hidden: torch.Tensor, start: torch.Tensor
    ) -> torch.Tensor:
        begun.append((torch.cat([observation, previous], dim=-1)[:, 0], hidden))
        return learning(observation, previous, hidden, start)

    monkeypatch.setattr(policy, "remember", remember)
    monkeypatch.setattr(policy, "remember_sequence", remember_sequence)
    train(learner)
    moments, memories = (torch.cat(column) for column in zip(*begun, strict=True))
    assert memories.tolist() == [acted[tuple(moment.tolist())] for moment in moments]
    assert float((memories.abs().amax(-1) > 0).float().mean()) > 0.5


def test_the_memory_that_values_come_from_follows_slowly() -> None:
    learner = sac(
        GoToZero(8),
        20,
        horizon=9,
        memory=4,
        window=2,
        burn_in=0,
        rollout_steps=1,
        updates_per_step=1,
        target_rate=0.1,
    )
    late_critics, critics = learner._late_critics, learner._critics
    expected = _memory_of(late_critics)
    while not learner.done:
        learner.iterate()
        now = _memory_of(critics)
        expected = [0.9 * before + 0.1 * after for before, after in zip(expected, now, strict=True)]
        for late, values in zip(_memory_of(late_critics), expected, strict=True):
            torch.testing.assert_close(late, values, atol=1e-6, rtol=0)
    assert any((a - b).abs().max() > 1e-4 for a, b in zip(now, expected, strict=True))


def _memory_of(critics: nn.Module) -> list[torch.Tensor]:
    return [
        values.detach().clone() for name, values in critics.named_parameters() if name.startswith("memory")
    ]


@pytest.mark.parametrize("memory", [0, 8])
def test_an_update_is_that_of_the_printed_losses(memory: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Haarnoja et al. (2018), by hand from the windows that were drawn."""
    settings: dict[str, Any] = {"window": 6, "burn_in": 2, "batch_size": 512, "initial_temperature": 0.4}
    learner = sac(EndsAtZero(8), 60, horizon=9, memory=memory, reward_scale=3.0, target_rate=0.3, **settings)
    for _ in range(3):
        learner.iterate()
    policy, critics, replay = learner.policy, learner._critics, learner._replay
    drawn: list[tuple[dict[str, torch.Tensor], torch.Tensor]] = []
    draw, compute, sample = replay.windows, learner._losses, policy.sample

    def windows(count: int, length: int, burn_in: int) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        drawn.append(draw(count, length, burn_in))
        return drawn[-1]

    losses: list[torch.Tensor] = []
    gradients: list[torch.Tensor] = []

    def computed(*given: Any) -> tuple[torch.Tensor, ...]:  # noqa: ANN401
        found = compute(*given)
        losses.extend(loss.detach() for loss in found)
        gradients.extend(torch.autograd.grad(found[0], [*critics.parameters()], retain_graph=True))
        return found

    def sampled(features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        torch.manual_seed(11)
        return sample(features)

    monkeypatch.setattr(replay, "windows", windows)
    monkeypatch.setattr(learner, "_losses", computed)
    monkeypatch.setattr(policy, "sample", sampled)
    before = copy.deepcopy((policy, critics, learner._late_critics))
    temperature = float(learner._log_temperature.detach().exp())
    learner._learn()
    (steps, learned) = drawn[0]
    actor, online, slow = before
    seen = steps["observation"], steps["previous_action"]
    first, nothing = steps["first"].float(), actor.initial_hidden(len(learned))

    def action_values(critics: Any, features: torch.Tensor, action: torch.Tensor) -> torch.Tensor:  # noqa: ANN401
        values = []
        for network in critics.networks:
            hidden = torch.cat([features, action], dim=-1)
            *inner, last = [layer for layer in network if not isinstance(layer, nn.ReLU)]
            for linear, norm in zip(inner[::2], inner[1::2], strict=True):
                hidden = hidden @ linear.weight.T + linear.bias
                hidden = (hidden - hidden.mean(-1, keepdim=True)) / (
                    hidden.var(-1, correction=0, keepdim=True) + 1e-5
                ).sqrt()
                hidden = torch.relu(hidden * norm.weight + norm.bias)
            values.append((hidden @ last.weight.T + last.bias)[..., 0])
        return torch.stack(values)

    def squashed(features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        torch.manual_seed(11)
        normal = torch.distributions.Normal(*actor.policy(features))
        raw = normal.rsample()
        return torch.tanh(raw), (normal.log_prob(raw) - torch.log(1.0 - torch.tanh(raw).square())).sum(-1)

    with torch.no_grad():
        acting = actor.remember_sequence(*seen, steps["hidden"][:, 0], first)
        judging = features_of(online.memory, *seen, nothing, first)
        late = features_of(slow.memory, *seen, nothing, first)
        following, log_prob = squashed(acting[:, 1:][learned])
        beyond = action_values(slow, late[:, 1:][learned], following).amin(0) - temperature * log_prob
        over, reward = steps["terminated"][:, :-1][learned], steps["reward"][:, :-1][learned]
        assert over.any() and not over.all()
        within = learned & ~steps["first"][:, 1:]
        shown = steps["observation"][:, 1:, 0][within]
        torch.testing.assert_close(steps["reward"][:, :-1][within], -3.0 * shown.square())
        target = reward + 0.9 * ~over * beyond
        given = action_values(online, judging[:, :-1][learned], steps["action"][:, :-1][learned])
        wrong = (given - target).square().sum(0).mean()
        action, log_prob = squashed(acting[:, :-1][learned])
        costs = (
            temperature * log_prob - action_values(online, judging[:, :-1][learned], action).amin(0)
        ).mean()
        # The temperature rises where actions are less random than one unit of entropy per dimension below 0.
        calm = -math.log(temperature) * (log_prob.mean() - 1.0)
    torch.testing.assert_close(torch.stack(losses), torch.stack([wrong, costs, calm]), rtol=1e-4, atol=1e-4)
    assert learner._log_temperature.grad is not None
    torch.testing.assert_close(learner._log_temperature.grad, 1.0 - log_prob.mean(), rtol=1e-4, atol=1e-5)
    # The critics and their memory learn from their own loss alone.
    for parameter, gradient in zip(critics.parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)
    after = zip(learner._late_critics.parameters(), slow.parameters(), critics.parameters(), strict=True)
    for late, then, now in after:
        torch.testing.assert_close(late, 0.7 * then + 0.3 * now)
    assert all(parameter.requires_grad for parameter in critics.parameters())


def test_it_learns_so_often_after_each_step_that_a_window_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = sac(GoToZero(8), 20, horizon=9, memory=4, window=4, burn_in=1, updates_per_step=3)
    at: list[int] = []
    monkeypatch.setattr(learner, "_learn", lambda: at.append(len(learner._replay)))
    learner.iterate()
    assert at == [kept for kept in range(5, 11) for _ in range(3)]


def test_a_memory_recalls_what_a_single_observation_does_not_show() -> None:
    settings: dict[str, Any] = {"horizon": 100, "window": 3, "burn_in": 0, "batch_size": 96}
    settings["updates_per_step"] = 3
    with_memory = train(sac(Recall(32), 120, memory=8, learning_rate=3e-3, **settings))
    without = train(sac(Recall(32), 120, learning_rate=3e-3, **settings))
    # An episode of three steps is worth at most 1.
    assert 3 * with_memory[-1]["reward"] > 0.7
    assert 3 * without[-1]["reward"] < 0.3


def test_metrics_count_finished_episodes() -> None:
    metrics = sac(ConstantReward(4, 8.0), 16, rollout_steps=16, horizon=10**6).iterate()
    assert metrics["episodes"] == 4 * 16 / 8
    assert metrics["episode_steps"] == 8
    assert metrics["success"] == 1.0
    assert metrics["reward"] == pytest.approx(1.0)


def test_a_training_that_diverges_says_so() -> None:
    learner = sac(GoToZero(4), 40, horizon=20, learning_rate=1e30)
    with pytest.raises(BadInputError, match=r"diverged after step .* with a loss that is not finite: make"):
        train(learner)


def test_a_window_has_to_hold_steps_to_learn_from() -> None:
    with pytest.raises(ValueError, match=r"burn_in: expected less than the window of 8, got 8"):
        SacConfig(window=8, burn_in=8)
    with pytest.raises(ValueError, match=r"batch_size: expected a window of 32 or more, got 16"):
        SacConfig(batch_size=16)


def test_the_buffer_has_to_hold_a_window() -> None:
    sizes: dict[str, Any] = {"horizon": 9, "memory": 8, "window": 6, "burn_in": 0}
    with pytest.raises(BadInputError, match=r"buffer_size: expected at least 56 steps.* got 55"):
        sac(GoToZero(8), 10, buffer_size=55, **sizes)
    sac(GoToZero(8), 10, buffer_size=56, **sizes)


def still(steps: int = 9) -> Recorded:
    nothing = torch.zeros(2, steps, 1)
    return Recorded(nothing, nothing, nothing + 0.5, torch.full((2,), steps))


@pytest.mark.parametrize(("memory", "windows"), [(0, (64, 1, 0)), (8, (10, 6, 2))])
def test_an_update_takes_as_many_windows_as_its_steps_make(
    memory: int, windows: tuple[int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their number, their steps, and those that only warm up a memory."""
    learner = sac(GoToZero(8), 40, horizon=9, memory=memory, window=6, burn_in=2, recorded=still())
    drawn: list[tuple[int, ...]] = []
    for of in (type(learner._replay), Recorded):
        draw = of.windows

        def counted(self: Any, count: int, *sizes: int, draw: Any = draw) -> Any:  # noqa: ANN401
            drawn.append((count, *sizes))
            return draw(self, count, *sizes)

        monkeypatch.setattr(of, "windows", counted)
    learner.iterate()
    assert set(drawn) == {windows}


def test_imitation_weighs_as_much_as_values_are_large_and_leaves_them_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    learner = sac(GoToZero(8), 40, horizon=9, recorded=still(), imitation_weight=0.4)
    learner.iterate()
    parameters, parts = [*learner.policy.parameters()], list[tuple[float, Any]]()
    compute, distance = learner._losses, learner._distance

    def noted(loss: torch.Tensor) -> None:
        gradient = torch.autograd.grad(loss, parameters, retain_graph=True, allow_unused=True)
        parts.append((abs(float(loss.detach())), gradient))

    def losses(*given: Any) -> Any:  # noqa: ANN401
        found = compute(*given)
        noted(found[1])
        return found

    def apart(recorded: Recorded) -> torch.Tensor:
        found = distance(recorded)
        noted(found)
        return found

    monkeypatch.setattr(learner, "_losses", losses)
    monkeypatch.setattr(learner, "_distance", apart)
    learner._learn()
    (size, of_costs), (_, of_distance) = parts
    for parameter, one, other in zip(parameters, of_costs, of_distance, strict=True):
        torch.testing.assert_close(parameter.grad, one + (0.0 if other is None else 0.4 * size * other))


def test_where_every_step_runs_out_of_time_nothing_is_learned() -> None:
    learner = sac(GoToZero(8), 20, horizon=1)
    before = copy.deepcopy(learner.policy)
    assert [point["temperature"] for point in train(learner)] == pytest.approx([0.2] * 2)
    pairs = zip(before.parameters(), learner.policy.parameters(), strict=True)
    assert all(torch.equal(*pair) for pair in pairs)


def test_where_it_begins_is_of_the_seed_whatever_was_drawn_before() -> None:
    begun = []
    for drawn, seed in ((5, 1), (6, 1), (5, 2)):
        torch.manual_seed(drawn)
        policy, config = SoftActor(PolicyShape(1, 1, hidden_sizes=(8,))), SacConfig(buffer_size=1000)
        learner = Sac(GoToZero(8), policy, config, horizon=7, seed=seed)
        critics = [values.detach().flatten() for values in learner._critics.parameters()]
        begun.append(torch.cat([*critics, learner.acting.observation[:, 0]]))
    assert torch.equal(begun[0], begun[1]) and not torch.equal(begun[0], begun[2])
