from dataclasses import replace
from typing import Any

import pytest
import torch
from pydantic import ValidationError
from torch import Tensor
from toy_worlds import came_back

from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive
from astra_data.grounding.paired_episodes import draw_steps
from astra_data.methods import iql as module
from astra_data.methods.iql import Experience, Iql, IqlConfig, transitions
from astra_data.policies.networks import ActorCritic, Policy, PolicyShape

QUICK = IqlConfig(
    critic_updates=300,
    return_steps=1,
    reward_scale=5.0,
    discount=0.9,
    policy_updates=40,
    batch_windows=16,
    window=16,
    burn_in=4,
    learning_rate=1e-2,
)


CRITICS = {"_CRITIC_SIZES": (32, 32), "_CRITIC_LEARNING_RATE": 3e-3, "_TARGET_RATE": 0.05}


@pytest.fixture(autouse=True)
def _quick_critics(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in CRITICS.items():
        monkeypatch.setattr(module, name, value)


def config(**settings: Any) -> IqlConfig:
    return QUICK.model_copy(update=settings)


def walks(count: int = 64, steps: int = 24) -> Experience:
    """Return random walks on [0, 1] by 0.2 times the action; 1 is paid at the right end, where they end."""
    torch.manual_seed(0)
    place = torch.rand(count)
    lengths, ended = torch.full((count,), steps), torch.zeros(count, dtype=torch.bool)
    action = torch.rand(count, steps, 1) * 2 - 1
    columns: dict[str, list[Tensor]] = {"at": [], "after": [], "reward": [], "terminated": []}
    for step in range(steps):
        after = (place + 0.2 * action[:, step, 0]).clamp(0.0, 1.0)
        arrived = (after == 1.0) & ~ended
        for name, values in zip(columns, (place, after, arrived.float(), arrived), strict=True):
            columns[name].append(values)
        lengths = torch.where(arrived, step + 1, lengths)
        ended, place = ended | arrived, after
    at, after, reward, terminated = (torch.stack(values, dim=1) for values in columns.values())
    return Experience(
        observation=at.unsqueeze(-1),
        previous_action=torch.cat([torch.zeros(count, 1, 1), action[:, :-1]], dim=1),
        action=action,
        reward=reward,
        next_observation=after.unsqueeze(-1),
        terminated=terminated,
        lengths=lengths,
    )


def learner(experience: Experience, settings: IqlConfig, memory: int = 0) -> Iql:
    torch.manual_seed(1)
    return Iql(ActorCritic(PolicyShape(1, 1, memory, 8, (32,))), experience, settings, seed=2)


def trained(iql: Iql) -> Iql:
    while not iql.done:
        iql.iterate()
    return iql


def mean_action(policy: Policy) -> Tensor:
    """Return what the policy does at 0.1 to 0.7, with nothing remembered."""
    place = torch.linspace(0.1, 0.7, 7).unsqueeze(-1)
    with torch.no_grad():
        features, _ = policy.remember(place, torch.zeros(7, 1), policy.initial_hidden(7))
        return policy.act(features)[:, 0]


def test_it_finds_the_way_where_imitation_does_not() -> None:
    experience = walks()
    assert mean_action(trained(learner(experience, QUICK, memory=8)).policy).min() > 0.3
    imitated = trained(learner(experience, config(temperature=0.0, critic_updates=1), memory=8))
    assert mean_action(imitated.policy).abs().max() < 0.2


def constant_reward(*, terminated: bool) -> Experience:
    """Return episodes of three equal steps that pay 1 each; the last ends the task or only the record."""
    ended = torch.zeros(8, 3, dtype=torch.bool)
    ended[:, -1] = terminated
    place = torch.arange(3).float().expand(8, 3).unsqueeze(-1)
    torch.manual_seed(0)
    action = torch.rand(8, 3, 1) * 2 - 1
    ones = torch.ones(8, 3)
    # After the last step the world looks as after the second: only the mask tells that there is no more.
    following = (place + 1).clamp_max(2.0)
    lengths = torch.full((8,), 3)
    return Experience(
        observation=place,
        previous_action=torch.zeros_like(action),
        action=action,
        lengths=lengths,
        reward=ones,
        next_observation=following,
        terminated=ended,
    )


@pytest.mark.parametrize("expectile", [0.5, 0.8])
def test_a_state_is_worth_the_expectile_of_what_its_actions_pay(
    expectile: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Going right ends the task with 1, as often as going left with 0: V = τ, of τ (1 - V) = (1 - τ) V."""
    ended, at = torch.ones(8, 1, dtype=torch.bool), torch.zeros(8, 1, 1)
    pays = (torch.arange(8) % 2).float().unsqueeze(-1)
    experience = Experience(
        observation=at,
        previous_action=at,
        action=2.0 * pays.unsqueeze(-1) - 1.0,
        lengths=torch.ones(8, dtype=torch.int64),
        reward=pays,
        next_observation=at,
        terminated=ended,
    )
    monkeypatch.setattr(module, "_TARGET_RATE", 0.2)
    settings = config(expectile=expectile, reward_scale=1.0, policy_updates=0, critic_updates=600)
    iql = trained(learner(experience, settings))
    assert float(iql._critics.value(torch.zeros(1)).detach()) == pytest.approx(expectile, abs=0.03)


def test_returns_are_those_of_a_plain_loop() -> None:
    experience = walks(count=20, steps=7)
    padding = torch.arange(7) >= experience.lengths[:, None]
    assert padding.any()
    experience = replace(experience, reward=experience.reward + 5.0 * padding)
    settings = config(return_steps=3, discount=0.9, reward_scale=2.0)
    table = transitions(experience, settings)
    row = 0
    for episode, length in enumerate(experience.lengths.tolist()):
        for step in range(length):
            end = min(step + 3, length)
            if end < step + 3 and not experience.terminated[episode, length - 1]:
                continue
            rewards = 2.0 * experience.reward[episode, step:end]
            summed = sum(0.9**ahead * float(reward) for ahead, reward in enumerate(rewards))
            assert float(table.reward[row]) == pytest.approx(summed)
            assert torch.equal(table.observation[row], experience.observation[episode, step])
            assert torch.equal(table.next_observation[row], experience.next_observation[episode, end - 1])
            assert bool(table.terminated[row]) == bool(experience.terminated[episode, end - 1])
            row += 1
    assert row == len(table.reward)


def test_updates_are_those_of_the_printed_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kostrikov et al. (2022): expectile regression, then advantage-weighted regression."""
    monkeypatch.setattr(module, "_GRADIENT_NORM", 1e-3)
    settings = config(expectile=0.8, temperature=150.0, critic_updates=1, policy_updates=1, reward_scale=9.0)
    settings = settings.model_copy(update={"return_steps": 3})
    experience = walks()
    iql = learner(experience, settings)

    def advantage(observation: Tensor, action: Tensor) -> Tensor:
        """Return min Q - V, by the slow Q."""
        pair = torch.cat([observation, action], dim=-1)
        with torch.no_grad():
            first, second = (network(pair).squeeze(-1) for network in iql._critics.slow_action_values)
        return torch.as_tensor(torch.minimum(first, second) - iql._critics.value(observation).squeeze(-1).detach())

    table = transitions(experience, settings)
    torch.manual_seed(derive(2, "update 0"))
    rows = torch.randint(len(table.reward), (256,))
    ahead = advantage(table.observation[rows], table.action[rows])
    assert (ahead > 0).any() and (ahead < 0).any()
    expected = torch.where(ahead > 0, 0.8, 0.2) * ahead.square()
    with torch.no_grad():
        after = iql._critics.value(table.next_observation[rows]).squeeze(-1) * ~table.terminated[rows]
        pair = torch.cat([table.observation[rows], table.action[rows]], dim=-1)
        wanted = table.reward[rows] + 0.9**3 * after
        wrong = sum(float((q(pair).squeeze(-1) - wanted).square().mean()) for q in iql._critics.action_values)
    losses = iql.iterate()
    assert losses["value"] == pytest.approx(float(expected.mean()), rel=1e-4)
    assert losses["action_value"] == pytest.approx(wrong, rel=1e-4)
    torch.manual_seed(derive(2, "update 1"))
    steps, learned = experience.draw(16, 16, 4)
    observation, action = experience.observation[steps], experience.action[steps]
    weight = (150.0 * advantage(observation, action)).exp().clamp_max(100.0)
    assert (weight == 100.0).any() and (weight < 100.0).any()
    with torch.no_grad():
        normal = torch.distributions.Normal(*iql.policy.policy(observation))
        log_prob = normal.log_prob(action).sum(-1)
    expected = -(weight * log_prob)[learned].mean()
    assert iql.iterate()["policy"] == pytest.approx(float(expected), rel=1e-4)
    gradients = [part.grad.flatten() for part in iql.policy.parameters() if part.grad is not None]
    assert float(torch.cat(gradients).norm()) == pytest.approx(1e-3, rel=1e-2)


def test_settings_and_episodes_that_leave_nothing_to_learn_from_are_told() -> None:
    with pytest.raises(ValidationError, match="burn_in: expected less than the window of 10, got 10"):
        IqlConfig(window=10, burn_in=10)
    cut = constant_reward(terminated=False)
    with pytest.raises(BadInputError, match=r"at least 4 steps \(return_steps\).*the longest has 3"):
        transitions(cut, config(return_steps=4))
    assert len(transitions(constant_reward(terminated=True), config(return_steps=10**11)).reward) == 24


def test_a_training_that_diverges_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CRITIC_LEARNING_RATE", 1e30)
    iql = learner(walks(), config(critic_updates=20, policy_updates=1))
    with pytest.raises(BadInputError, match=r"diverged in update \d+, with a .*: make learning_rate smaller"):
        trained(iql)


@pytest.mark.parametrize("updates", [3, 8])
def test_resuming_gives_the_same_parameters_to_the_bit(updates: int) -> None:
    settings = config(critic_updates=5, policy_updates=6)
    whole = trained(learner(walks(), settings, memory=8))
    begun = learner(walks(), settings, memory=8)
    for _ in range(updates):
        begun.iterate()
    resumed = learner(walks(), settings, memory=8)
    resumed.load_state_dict(came_back(begun.state_dict()))
    trained(resumed)
    assert all(map(torch.equal, whole.policy.parameters(), resumed.policy.parameters()))


def test_the_policys_learning_rate_falls_along_a_half_cosine() -> None:
    iql = learner(walks(), config(critic_updates=1, policy_updates=4))
    iql.iterate()
    rates = []
    while not iql.done:
        iql.iterate()
        rates.append(iql._optimizer.param_groups[0]["lr"])
    assert rates == pytest.approx([1e-2 * share for share in (1.0, 0.85355, 0.5, 0.14645)], rel=1e-3)


@pytest.mark.parametrize("burn_in", [0, 3])
def test_the_first_steps_of_a_window_fill_the_memory(burn_in: int) -> None:
    column, lengths = torch.zeros(3, 25, 1), torch.tensor([3, 10, 25])
    experience = Experience(column, column, column, lengths, column, column, column)
    torch.manual_seed(1)
    (episodes, steps), learned = experience.draw(3_000, 8, burn_in)
    torch.manual_seed(1)
    expected_episodes, expected_steps, drawn = draw_steps(lengths, 3_000, 8)
    assert torch.equal(episodes, expected_episodes) and torch.equal(steps, expected_steps)
    is_filled = (torch.arange(8) >= burn_in) | (steps[:, :1] == 0)
    assert torch.equal(learned, drawn & (steps < lengths[episodes]) & is_filled) and learned.any()
