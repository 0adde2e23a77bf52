import copy
import math
from statistics import fmean
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn
from toy_worlds import ConstantReward, EndsAtZero, GoToZero, Recall, assert_resumes, train

from astra_data.core.errors import BadInputError
from astra_data.policies import ppo as module
from astra_data.policies.networks import ActorCritic, PolicyShape, ReturnScale
from astra_data.policies.ppo import Ppo, PpoConfig, generalized_advantages
from astra_data.worlds.protocols import BatchedEnv


@pytest.fixture(autouse=True)
def _two_minibatches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MINIBATCHES", 2)


def ppo(env: BatchedEnv, iterations: int, *, horizon: int, memory: int = 0, **settings: Any) -> Ppo:
    config = PpoConfig(
        total_steps=iterations * env.num_envs * 16, **{"rollout_steps": 16, "learning_rate": 3e-3, **settings}
    )
    torch.manual_seed(0)
    shape = PolicyShape(env.observation_size, env.action_size, memory, 16, (32,))
    return Ppo(env, ActorCritic(shape), config, horizon=horizon, seed=1)


def last_layer(learner: Ppo) -> nn.Linear:
    layer = learner.policy.actor[-1]
    assert isinstance(layer, nn.Linear)
    return layer


@pytest.mark.parametrize("memory", [0, 8])
def test_resuming_gives_the_same_parameters_to_the_bit(memory: int) -> None:
    assert_resumes(lambda: ppo(GoToZero(8), 6, horizon=7, memory=memory))


@pytest.mark.parametrize("terminates", [False, True])
def test_running_out_of_time_bootstraps_and_ending_does_not(terminates: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    # What comes next is seen to be new.
    monkeypatch.setattr(ConstantReward, "observe", lambda env: 1.0 + 9.0 * (env.state == 0.0))
    env, rollouts = ConstantReward(16, 5.0 if terminates else math.inf), []
    endless = ppo(ConstantReward(16, math.inf), 2, horizon=10**6, memory=8, rollout_steps=32)
    for one in (endless, ppo(env, 2, horizon=10**6 if terminates else 20, memory=8, discount=0.9)):
        list(one.policy.critic.parameters())[-2].data.mul_(100.0)
        torch.manual_seed(0)
        rollouts.append(one._collect())
    rollout, following = rollouts[1], rollouts[0]["value"][:, 1:17]
    done = rollout["done"]
    assert done.any() and torch.equal(rollout["terminated"], done & terminates) and following.abs().min() > 0.1
    assert (rollout["reward"] != 1.0).all()  # but in units of the returns' deviation
    # Both remember the same until the first episode of a row ends, or the rollout.
    ends = torch.arange(16) == torch.where(done.any(1), done.int().argmax(1), 15)[:, None]
    expected = rollout["reward"] + 0.9 * following * ~rollout["terminated"]
    torch.testing.assert_close(rollout["value_target"][ends], expected[ends])


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
            expected[row, first] += (0.9 * module.GAE_LAMBDA) ** (step - first) * error
            if done[row, step]:
                break
    parts = [torch.from_numpy(part) for part in (value, following, reward, done, terminated)]
    found = generalized_advantages(*parts, discount=0.9).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_an_update_is_that_of_the_printed_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    """With means that are clipped to ±1, and pulled back there."""
    settings = {"EPOCHS": 3, "MINIBATCHES": 1, "CLIP": 0.05, "VALUE_WEIGHT": 0.7, "_MAX_KL": math.inf}
    for name, value in {**settings, "GRADIENT_NORM": 0.3, "_PULL": 0.4}.items():
        monkeypatch.setattr(module, name, value)
    learner = ppo(EndsAtZero(32), 3, horizon=5)
    assert float(list(learner.policy.critic.parameters())[-2].norm().detach()) == pytest.approx(0.01)
    last_layer(learner).weight.data.mul_(300.0)
    last_layer(learner).bias.data.fill_(0.8)
    ours, theirs = learner.policy, copy.deepcopy(learner.policy)
    rollout = learner._collect()
    kept = {name: values.clone() for name, values in rollout.items()}
    learner._learn(rollout)
    optimizer = torch.optim.Adam(theirs.parameters(), lr=3e-3, eps=1e-5)
    target = kept["value_target"]
    advantage = (kept["advantage"] - kept["advantage"].mean()) / kept["advantage"].std()
    for epoch in range(3):
        output, std = theirs.actor(kept["observation"]), theirs.log_std.exp()
        beyond = output.detach().abs() > 1.0
        assert beyond.any() and not beyond.all()
        mean = torch.where(beyond, output - output.detach() + output.detach().sign(), output)
        normal = torch.distributions.Normal(mean, std)
        ratio = (normal.log_prob(kept["action"]).sum(-1) - kept["action_log_prob"]).exp()
        clipped = ratio.clamp(0.95, 1.05)
        assert epoch == 0 or ((ratio - clipped).abs() > 0).any()
        gain = torch.minimum(ratio * advantage, clipped * advantage).mean()
        wrong = (theirs.value(kept["observation"]) - target).square().mean()
        pull = torch.where(beyond, output.abs() - 1.0, 0.0).square().mean()
        loss = 0.7 * wrong - gain + 0.4 * pull
        gradients = torch.autograd.grad(loss, list(theirs.parameters()))
        norm = torch.cat([gradient.flatten() for gradient in gradients]).norm()
        assert norm > 0.3
        for parameter, gradient in zip(theirs.parameters(), gradients, strict=True):
            parameter.grad = gradient * 0.3 / norm
        optimizer.step()
    for name, value in ours.state_dict().items():
        torch.testing.assert_close(value, theirs.state_dict()[name], atol=1e-5, rtol=1e-3, msg=name)


def test_a_segment_begins_with_the_memory_that_the_policy_acted_with(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = ppo(Recall(4), 1, horizon=5, memory=8, rollout_steps=40)
    batches: list[dict[str, torch.Tensor]] = []

    def diverged(batch: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        batches.append(batch)
        return torch.zeros(()), torch.tensor(-9.0)

    monkeypatch.setattr(learner, "_loss", diverged)
    learner._learn(learner._collect())
    (batch,) = batches  # where learning stops
    assert batch["action"].shape == (8, 10, 1)  # half of the four segments of four environments
    assert batch["hidden"].abs().amax(1).gt(0.01).any()
    seen = (batch[name] for name in ("observation", "previous_action", "hidden", "start"))
    with torch.no_grad():
        found = learner.policy.log_prob(learner.policy.remember_sequence(*seen), batch["action"])
    torch.testing.assert_close(found, batch["action_log_prob"], atol=1e-5, rtol=1e-5)


def test_the_learning_rate_falls_to_zero_along_a_line() -> None:
    learner = ppo(GoToZero(4), 4, horizon=5)
    rates = []
    while not learner.done:
        learner.iterate()
        rates.append(learner._optimizer.param_groups[0]["lr"])
    assert rates == pytest.approx([3e-3 * left for left in (1.0, 0.75, 0.5, 0.25)])


def test_a_memory_recalls_what_a_single_observation_does_not_show() -> None:
    settings: dict[str, Any] = {"horizon": 100, "learning_rate": 1e-2}
    with_memory = train(ppo(Recall(32), 25, memory=8, **settings))
    # An episode of three steps is worth at most 1.
    assert 3 * fmean(point["reward"] for point in with_memory[-5:]) > 0.7


def test_a_training_that_diverges_says_so() -> None:
    learner = ppo(GoToZero(4), 8, horizon=20, learning_rate=1e30)
    with pytest.raises(BadInputError, match=r"diverged after step .* std that is not finite: make learning_rate sm"):
        train(learner)


def test_a_single_step_has_no_advantage_over_others() -> None:
    with pytest.raises(BadInputError, match="rollout_steps: expected 2 or more in a single environment, got 1"):
        ppo(GoToZero(1), 2, horizon=5, rollout_steps=1)
    train(ppo(GoToZero(1), 1, horizon=5, rollout_steps=2))  # fewer environments than minibatches are enough
    train(ppo(GoToZero(2), 1, horizon=5, rollout_steps=1))


@pytest.mark.parametrize(("learned", "share"), [(1.0, 0.5), (1.0, 1.0), (0.1, 0.5)])
def test_the_actions_scatter_falls_to_what_is_tested_and_may_be_less(
    learned: float, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_FADE_SHARE", share)
    learner = ppo(GoToZero(8), 4, horizon=7)
    monkeypatch.setattr(learner, "_learn", lambda _: learner.policy.log_std.data.fill_(math.log(learned)))
    first, done = math.exp(-0.5), [min(1.0, one / share) for one in (0.0, 0.25, 0.5, 0.75)]
    expected = [min(learned, first ** (1 - one) * 0.15**one) for one in done]
    assert [point["std"] for point in train(learner)] == pytest.approx(expected, rel=1e-4)


def test_rewards_are_scaled_as_by_stable_baselines() -> None:
    rows = DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")] * 4)
    theirs = VecNormalize(rows, norm_obs=False, gamma=0.9)
    ours, rng = ReturnScale(4, 0.9), np.random.default_rng(0)
    for step in range(60):
        reward = (rng.normal(size=4) * (100.0 if step == 30 else 3.0)).astype(np.float32)
        if step == 50:
            reward[0] = 1e4  # of one row, so that it is clipped
        done = rng.random(4) < 0.2
        theirs._update_reward(reward)
        expected = theirs.normalize_reward(reward)
        theirs.returns[done] = 0.0
        found = ours.scaled(torch.from_numpy(reward), torch.from_numpy(done))
        np.testing.assert_allclose(found.numpy(), expected, rtol=2e-4)
        if step == 40:
            saved = {name: values.clone() for name, values in ours.state_dict().items()}
            ours.scaled(torch.ones(4), torch.zeros(4, dtype=torch.bool))  # goes on elsewhere
            ours = ReturnScale(4, 0.9)
            ours.load_state_dict(saved)
