import copy
import math
from functools import partial
from statistics import fmean
from typing import Any

import numpy as np
import pytest
import torch
from kept_states import came_back
from torch import Tensor
from toy_worlds import ConstantReward, EndsAtZero, GoToZero, Recall

from astra_data.core.errors import BadInputError
from astra_data.learning.networks.actor_critic import ActorCritic, ActorCriticShape
from astra_data.learning.ppo import Ppo, PpoConfig, generalized_advantages
from astra_data.worlds.batched import BatchedEnv


def ppo(
    env: BatchedEnv,
    iterations: int,
    *,
    horizon: int,
    memory: int = 0,
    clips: bool = False,
    **settings: Any,  # noqa: ANN401
) -> Ppo:
    config = PpoConfig(
        total_steps=iterations * env.num_envs * 16,
        **{"rollout_steps": 16, "learning_rate": 3e-3, "reward_scale": 1.0, "minibatches": 2, **settings},
    )
    torch.manual_seed(0)
    shape = ActorCriticShape(env.observation_size, env.action_size, memory, 16, (32,), clips_mean=clips)
    return Ppo(env, ActorCritic(shape), config, horizon=horizon, seed=1)


unscaled_ppo = ppo


def train(learner: Ppo) -> list[dict[str, float]]:
    metrics = []
    while not learner.done:
        metrics.append(learner.iterate())
    return metrics


def distance_after(policy: ActorCritic, steps: int) -> float:
    """Return how far from 0 the policy's mean action leaves points that start at ±1."""
    place = torch.tensor([[-1.0], [1.0]])
    with torch.no_grad():
        for _ in range(steps):
            place = (place + 0.2 * policy.policy(place)[0]).clamp(-1.0, 1.0)
    return float(place.abs().max())


def test_learns_to_go_to_a_target() -> None:
    learner = ppo(GoToZero(32), 40, horizon=20)
    assert distance_after(learner.policy, 10) > 0.8
    train(learner)
    assert distance_after(learner.policy, 10) < 0.15


@pytest.mark.parametrize(("memory", "normalize"), [(0, False), (8, False), (0, True)])
def test_resuming_gives_the_same_parameters_to_the_bit(memory: int, normalize: bool) -> None:
    ppo = partial(unscaled_ppo, normalize_returns=normalize)
    whole = ppo(GoToZero(8), 6, horizon=7, memory=memory)
    train(whole)
    world, other_world = GoToZero(8), GoToZero(8)
    begun = ppo(world, 6, horizon=7, memory=memory)
    for _ in range(3):
        begun.iterate()
    saved = came_back({"ppo": begun.state_dict(), "world": world.state_dict()})
    begun.iterate()  # goes on elsewhere; must not reach into what was saved
    resumed = ppo(other_world, 6, horizon=7, memory=memory)
    resumed.load_state_dict(saved["ppo"], other_world.load_state_dict(saved["world"]))
    assert resumed.steps == whole.steps / 2
    train(resumed)
    for name, value in whole.policy.state_dict().items():
        assert torch.equal(value, resumed.policy.state_dict()[name]), name


@pytest.mark.parametrize(("terminates_after", "expected"), [(float("inf"), 10.0), (10.0, 4.1)])
def test_running_out_of_time_bootstraps_and_ending_does_not(terminates_after: float, expected: float) -> None:
    """One unit each step is worth 1 / (1 - 0.9) = 10, or the mean over an ending episode of 10 steps."""
    horizon = 10 if terminates_after > 10 else 1000
    env = ConstantReward(16, terminates_after)
    learner = ppo(env, 60, horizon=horizon, discount=0.9, learning_rate=0.01, gradient_norm=10.0)
    train(learner)
    with torch.no_grad():
        value = float(learner.policy.value(torch.ones(1, 1)))
    assert value == pytest.approx(expected, rel=0.12)


def test_generalized_advantages_are_discounted_sums_of_errors_up_to_the_episodes_end() -> None:
    rng = np.random.default_rng(0)
    value, following, reward = rng.normal(size=(3, 4, 30))
    done, terminated = rng.random((4, 30)) < 0.2, rng.random((4, 30)) < 0.5
    terminated &= done
    expected = np.zeros((4, 30))
    for row, first in np.ndindex(4, 30):
        for step in range(first, 30):
            error = reward[row, step] - value[row, step]
            error += 0 if terminated[row, step] else 0.9 * following[row, step]
            expected[row, first] += (0.9 * 0.8) ** (step - first) * error
            if done[row, step]:
                break
    parts = [torch.from_numpy(part) for part in (value, following, reward, done, terminated)]
    found = generalized_advantages(*parts, discount=0.9, gae_lambda=0.8).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("memory", [0, 8])
def test_advantages_are_those_of_a_plain_loop(memory: int) -> None:
    env = EndsAtZero(32)
    learner = ppo(env, 3, horizon=5, memory=memory, discount=0.9, gae_lambda=0.8, reward_scale=0.5)
    learner.iterate()  # from here on, memories and actions go on from the last stretch
    env.steps.clear()
    policy, acting = learner.policy, learner.acting
    hidden, previous = acting.hidden.clone(), acting.previous_action.clone()
    torch.manual_seed(3)
    rollout = learner._collect()
    assert torch.equal(rollout["hidden"], hidden)
    done, terminated = rollout["done"], rollout["terminated"]
    ends = done.nonzero()
    assert terminated.any() and (done & ~terminated).any() and len(ends) > 64
    value, after = torch.zeros(2, 32, 16)
    with torch.no_grad():
        for step in range(16):
            assert torch.equal(rollout["previous_action"][:, step], previous)
            features, hidden = policy.remember(rollout["observation"][:, step], previous, hidden)
            action = rollout["action"][:, step]
            mean, std = policy.policy(features)
            log_prob = -((action - mean) / std).square() / 2 - std.log() - math.log(2 * math.pi) / 2
            torch.testing.assert_close(rollout["action_log_prob"][:, step], log_prob.sum(-1))
            value[:, step] = policy.value(features)
            executed = action.clamp(-1.0, 1.0)
            beyond, _ = policy.remember(env.steps[step].observation, executed, hidden)
            after[:, step] = policy.value(beyond)
            going = (~done[:, step]).float().unsqueeze(-1)
            hidden, previous = hidden * going, executed * going
    advantage = torch.zeros(32, 17)
    for step in reversed(range(16)):
        reward = 0.5 * env.steps[step].reward
        wrong = reward + 0.9 * after[:, step] * ~env.steps[step].terminated - value[:, step]
        advantage[:, step] = wrong + 0.9 * 0.8 * advantage[:, step + 1] * ~done[:, step]
    torch.testing.assert_close(rollout["value"], value)
    torch.testing.assert_close(rollout["advantage"], advantage[:, :-1], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(rollout["value_target"], advantage[:, :-1] + value, atol=1e-5, rtol=1e-4)


def test_an_update_is_that_of_the_printed_loss() -> None:
    settings: dict[str, Any] = {
        "epochs": 3,
        "minibatches": 1,
        "clip": 0.05,
        "entropy_weight": 0.02,
        "value_weight": 0.7,
    }
    learner = ppo(EndsAtZero(32), 3, horizon=5, gradient_norm=0.3, **settings)
    ours, theirs = learner.policy, copy.deepcopy(learner.policy)
    rollout = learner._collect()
    kept = {name: values.clone() for name, values in rollout.items()}
    learner._learn(rollout)
    optimizer = torch.optim.Adam(theirs.parameters(), lr=3e-3, eps=1e-5)
    target = kept["value_target"]
    advantage = (kept["advantage"] - kept["advantage"].mean()) / kept["advantage"].std()
    for epoch in range(3):
        mean, std = theirs.policy(kept["observation"])
        normal = torch.distributions.Normal(mean, std)
        ratio = (normal.log_prob(kept["action"]).sum(-1) - kept["action_log_prob"]).exp()
        clipped = ratio.clamp(0.95, 1.05)
        assert epoch == 0 or ((ratio - clipped).abs() > 0).any()
        gain = torch.minimum(ratio * advantage, clipped * advantage).mean()
        wrong = (theirs.value(kept["observation"]) - target).square().mean()
        loss = 0.7 * wrong - gain - 0.02 * normal.entropy().sum(-1).mean()
        gradients = torch.autograd.grad(loss, list(theirs.parameters()))
        norm = torch.cat([gradient.flatten() for gradient in gradients]).norm()
        assert norm > 0.3
        for parameter, gradient in zip(theirs.parameters(), gradients, strict=True):
            parameter.grad = gradient * 0.3 / norm
        optimizer.step()
    for name, value in ours.state_dict().items():
        torch.testing.assert_close(value, theirs.state_dict()[name], atol=1e-5, rtol=1e-3, msg=name)


def test_the_learning_rate_falls_to_zero_along_a_line() -> None:
    learner = ppo(GoToZero(4), 4, horizon=5)
    rates = []
    while not learner.done:
        learner.iterate()
        rates.append(learner._optimizer.param_groups[0]["lr"])
    assert rates == pytest.approx([3e-3 * left for left in (1.0, 0.75, 0.5, 0.25)])


def test_an_epoch_learns_from_every_row_once(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = ppo(GoToZero(10), 1, horizon=5, epochs=2, minibatches=4, memory=2)
    rollout = learner._collect()
    starts = rollout["observation"][:, 0, 0]
    learned: list[list[int]] = []
    remember = learner.policy.remember_sequence

    def watched(observation: Tensor, *rest: Tensor) -> Tensor:
        learned.append([int((starts == start).nonzero()) for start in observation[:, 0, 0]])
        return remember(observation, *rest)

    monkeypatch.setattr(learner.policy, "remember_sequence", watched)
    learner._learn(rollout)
    assert [len(rows) for rows in learned] == [3, 3, 3, 1] * 2
    for epoch in (learned[:4], learned[4:]):
        assert sorted(row for rows in epoch for row in rows) == list(range(10))
    assert learned[:4] != learned[4:]


def test_a_memory_recalls_what_a_single_observation_does_not_show() -> None:
    settings: dict[str, Any] = {"horizon": 100, "learning_rate": 1e-2, "minibatches": 2}
    with_memory = train(ppo(Recall(32), 25, memory=8, **settings))
    without = train(ppo(Recall(32), 25, **settings))
    # An episode of three steps is worth at most 1.
    assert 3 * fmean(point["reward"] for point in with_memory[-5:]) > 0.7
    assert 3 * fmean(point["reward"] for point in without[-5:]) < 0.2


def test_metrics_count_finished_episodes() -> None:
    metrics = ppo(ConstantReward(4, 8.0), 1, horizon=10**6).iterate()
    assert metrics["episodes"] == 4 * 16 / 8
    assert (metrics["success"], metrics["episode_steps"]) == (1.0, 8.0)
    assert metrics["reward"] == pytest.approx(1.0)


def test_who_is_restarted_early_at_first_lasted_as_long_as_it_did() -> None:
    learner = ppo(ConstantReward(64, math.inf), 2, horizon=8)
    first, second = learner.iterate(), learner.iterate()
    # Of ages from 0 to 7, all end once by the eighth step, and then every eight.
    assert first["episodes"] == pytest.approx(128, abs=32)
    assert second["episodes"] == 128
    assert 4 < first["episode_steps"] < 8 == second["episode_steps"]


def test_without_finished_episodes_success_is_unknown() -> None:
    metrics = ppo(ConstantReward(4, math.inf), 1, horizon=10**6).iterate()
    assert metrics["episodes"] == 0
    assert math.isnan(metrics["success"]) and math.isnan(metrics["episode_steps"])
    assert metrics["reward"] == pytest.approx(1.0)


def test_fewer_environments_than_minibatches_are_enough() -> None:
    train(ppo(GoToZero(2), 2, horizon=5, minibatches=4))


def test_a_training_that_diverges_says_so() -> None:
    learner = ppo(GoToZero(4), 8, horizon=20, learning_rate=1e30)
    with pytest.raises(
        BadInputError, match=r"diverged after step .* std that is not finite: make learning_rate sm"
    ):
        train(learner)


def test_a_single_step_has_no_advantage_over_others() -> None:
    with pytest.raises(
        BadInputError, match="rollout_steps: expected 2 or more in a single environment, got 1"
    ):
        ppo(GoToZero(1), 2, horizon=5, rollout_steps=1)
    train(ppo(GoToZero(1), 1, horizon=5, rollout_steps=2))
    train(ppo(GoToZero(2), 1, horizon=5, rollout_steps=1))


def test_an_untrained_critic_may_begin_near_zero() -> None:
    plain, small = (ppo(GoToZero(8), 1, horizon=7, critic_gain=gain).policy for gain in (1.0, 0.01))
    seen = torch.linspace(-1, 1, 9)[:, None]
    torch.testing.assert_close(small.value(seen), 0.01 * plain.value(seen))
    assert torch.equal(small.policy(seen)[0], plain.policy(seen)[0])


@pytest.mark.parametrize(("length", "horizon"), [(8.0, 10**6), (math.inf, 8)])
def test_returns_may_be_normalized(length: float, horizon: int) -> None:
    """A unit each step for 8 steps: discounted sums by the age of the row, of a deviation below 2.3."""
    learner = ppo(ConstantReward(64, length), 20, horizon=horizon, normalize_returns=True, discount=0.9)
    train(learner)
    sums = [(1 - 0.9**age) / 0.1 for age in range(1, 9)]
    deviation = math.sqrt(fmean(value**2 for value in sums) - fmean(sums) ** 2)
    reward = learner._collect()["reward"]
    torch.testing.assert_close(reward, torch.full_like(reward, 1 / deviation), rtol=0.02, atol=0)


@pytest.mark.parametrize(
    ("fade", "shares"), [(1.0, [0.0, 0.25, 0.5, 0.75]), (0.5, [0.0, 0.5, 1.0, 1.0]), (0.0, [1.0] * 4)]
)
def test_the_actions_scatter_may_fall_to_what_is_tested(fade: float, shares: list[float]) -> None:
    learner = ppo(GoToZero(8), 4, horizon=7, final_std=0.1, std_fade=fade, entropy_weight=1.0)
    first = math.exp(-0.5)
    expected = [first ** (1 - share) * 0.1**share for share in shares]
    assert [point["std"] for point in train(learner)] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(("most_kl", "updates"), [(None, 10), (1e9, 10), (1e-9, 1)])
def test_an_iteration_ends_once_the_policy_has_moved_too_far(most_kl: float | None, updates: int) -> None:
    """Before the first update nothing has moved; the second minibatch of the first pass sees that it has."""
    learner = ppo(GoToZero(8), 3, horizon=7, epochs=5, minibatches=2, most_kl=most_kl)
    made: list[None] = []
    learner._optimizer.register_step_post_hook(lambda *_: made.append(None))
    learner.iterate()
    assert len(made) == updates


@pytest.mark.parametrize(
    ("pull", "begin", "least", "most"), [(0.0, 3.0, 2.7, 3.3), (5.0, 3.0, 0.9, 2.5), (5.0, 0.5, 0.3, 0.7)]
)
def test_a_clipped_mean_is_pulled_back_to_its_bound_and_no_farther(
    pull: float, begin: float, least: float, most: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every action is worth the same, so that nothing but the pull moves the mean."""
    monkeypatch.setattr("astra_data.learning.ppo._PULL", pull)
    settings: dict[str, Any] = {"entropy_weight": 0.0, "clip": 1e-6, "learning_rate": 0.02}
    learner = ppo(ConstantReward(8, 1.0), 60, horizon=10**6, clips=True, **settings)
    last = learner.policy.actor[-1]
    assert isinstance(last, torch.nn.Linear)
    with torch.no_grad():
        last.weight.zero_()
        last.bias.fill_(-begin)
    train(learner)
    seen = learner.policy.actor(torch.zeros(1, learner.policy.shape.feature_size))[0]
    assert least < -float(seen[0].detach()) < most


def test_a_clipped_mean_learns_to_turn_back_from_its_bound() -> None:
    """Begun far beyond the bound, the way back to zero is as short as any: a tanh would be flat."""
    reached = {}
    for clips in (False, True):
        learner = ppo(GoToZero(32), 40, horizon=7, clips=clips)
        last = learner.policy.actor[-1]
        assert isinstance(last, torch.nn.Linear)
        with torch.no_grad():
            last.bias.fill_(6.0)
        train(learner)
        reached[clips] = distance_after(learner.policy, 7)
    assert reached[True] < 0.3 < reached[False]


@pytest.mark.parametrize("memory", [0, 8])
def test_a_loss_is_all_on_the_device_of_the_policy(memory: int) -> None:
    """On "meta", which holds no values and refuses tensors of the CPU beside its own."""
    learner = ppo(GoToZero(8), 1, horizon=7, memory=memory, clips=True)
    rollout = learner._collect()
    learner.policy.to("meta")
    loss, moved = learner._loss({name: values.to("meta") for name, values in rollout.items()})
    loss.backward()
    assert (loss.device.type, moved.device.type) == ("meta", "meta")


def test_actions_that_scatter_less_than_is_tested_are_left_so() -> None:
    learner = ppo(GoToZero(8), 4, horizon=7, final_std=0.5, entropy_weight=0.0)
    with torch.no_grad():
        learner.policy.log_std.fill_(math.log(0.1))
    assert max(point["std"] for point in train(learner)) < 0.2


def test_where_it_begins_is_of_the_seed_whatever_was_drawn_before() -> None:
    begun = []
    for drawn, seed in ((5, 1), (6, 1), (5, 2)):
        torch.manual_seed(drawn)
        policy = ActorCritic(ActorCriticShape(1, 1, hidden_sizes=(8,)))
        acting = Ppo(GoToZero(8), policy, PpoConfig(), horizon=100, seed=seed).acting
        begun.append(torch.cat([acting.observation[:, 0], acting.state_dict()["age"]]))
    assert torch.equal(begun[0], begun[1]) and not torch.equal(begun[0], begun[2])
