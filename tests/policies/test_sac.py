import copy
import math
from typing import Any

import pytest
import torch
from torch import nn
from toy_worlds import EndsAtZero, GoToZero, assert_resumes

from astra_data.core.errors import BadInputError
from astra_data.policies import sac as module
from astra_data.policies.networks import PolicyShape, SoftActor
from astra_data.policies.sac import Replay, Sac, SacConfig
from astra_data.policies.simulator_env import Recorded
from astra_data.worlds.protocols import BatchedEnv


def sac(
    env: BatchedEnv, steps: int, *, horizon: int, memory: int = 0, recorded: Recorded | None = None, **settings: Any
) -> Sac:
    usual = {"rollout_steps": 10, "updates_per_step": 2, "batch_size": 64, "discount": 0.9}
    config = SacConfig(total_steps=steps * env.num_envs, **{**usual, **settings})
    torch.manual_seed(0)
    shape = PolicyShape(env.observation_size, env.action_size, memory, 16, (32, 32))
    return Sac(env, SoftActor(shape), config, horizon=horizon, seed=1, recorded=recorded)


def test_the_second_half_learns_ever_more_slowly() -> None:
    with pytest.raises(BadInputError, match="buffer_size: expected at least 34 steps, for a window of 16 in 2 env"):
        sac(GoToZero(2), 80, horizon=7, memory=8, buffer_size=33)
    learner = sac(GoToZero(8), 80, horizon=7, updates_per_step=1)
    rates = []
    while not learner.done:
        learner.iterate()
        rates.append(learner._optimizer.param_groups[0]["lr"] / 3e-4)
    assert rates == pytest.approx([1.0, 1.0, 1.0, 1.0, 1.0, 0.75, 0.5, 0.25])


@pytest.mark.parametrize("memory", [0, 8])
def test_resuming_gives_the_same_parameters_to_the_bit(memory: int) -> None:
    # The replay has wrapped around by then.
    settings: dict[str, Any] = {"window": 6, "burn_in": 2, "buffer_size": 8 * 25, "updates_per_step": 1}
    assert_resumes(lambda: sac(GoToZero(8), 60, horizon=7, memory=memory, **settings))


def test_where_the_episodes_cannot_go_on_its_replay_does_not_either() -> None:
    """The first step of the new ones doesn't follow the last one that was kept."""
    learner, again = (sac(GoToZero(4), 40, horizon=20) for _ in range(2))
    learner.iterate()
    again.load_state_dict(learner.state_dict(), again.env.reset(), goes_on=False)
    kept, cut = (torch.as_tensor(one.state_dict()["replay"]["expired"]) for one in (learner, again))
    assert torch.equal(cut[:-1], kept[:-1]) and cut[-1].all() and not kept[-1].any()


@pytest.mark.parametrize(("memory", "imitates"), [(0, False), (8, False), (8, True)])
def test_an_update_is_that_of_the_printed_losses(memory: int, imitates: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Haarnoja et al. (2018), and Fujimoto and Gu (2021), by hand from the windows that were drawn."""
    settings: dict[str, Any] = {"window": 6, "burn_in": 2, "batch_size": 512}
    scale = -3.0 if imitates else 3.0  # so that action values have either sign
    for name, value in {"_TARGET_RATE": 0.3, "_INITIAL_TEMPERATURE": 0.4, "_REWARD_SCALE": scale}.items():
        monkeypatch.setattr(module, name, value)
    told, commands = torch.randn(5, 20, 1), torch.randn(5, 20, 1).tanh()
    recorded = Recorded(told, commands.roll(1, 1), commands, torch.tensor([20, 12, 3, 9, 20]))
    copied: list[tuple[tuple[torch.Tensor, torch.Tensor], torch.Tensor]] = []
    choose = Recorded.draw

    def chosen(*given: Any) -> tuple[tuple[torch.Tensor, torch.Tensor], torch.Tensor]:
        copied.append(choose(*given))
        return copied[-1]

    monkeypatch.setattr(Recorded, "draw", chosen)
    learner = sac(EndsAtZero(8), 60, horizon=9, memory=memory, recorded=recorded if imitates else None, **settings)
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

    def computed(*given: Any) -> tuple[torch.Tensor, ...]:
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

    def action_values(critics: Any, features: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
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
        judging = online.remember_sequence(*seen, nothing, first)
        late = slow.remember_sequence(*seen, nothing, first)
        following, log_prob = squashed(acting[:, 1:][learned])
        beyond = action_values(slow, late[:, 1:][learned], following).amin(0) - temperature * log_prob
        over, reward = steps["terminated"][:, :-1][learned], steps["reward"][:, :-1][learned]
        assert over.any() and not over.all()
        expired = steps["first"][:, 1:] & ~steps["terminated"][:, :-1]
        assert expired.any() and not (learned & expired).any()
        within = learned & ~steps["first"][:, 1:]
        shown = steps["observation"][:, 1:, 0][within]
        torch.testing.assert_close(steps["reward"][:, :-1][within], -scale * shown.square())
        target = reward + 0.9 * ~over * beyond
        given = action_values(online, judging[:, :-1][learned], steps["action"][:, :-1][learned])
        wrong = (given - target).square().sum(0).mean()
        action, log_prob = squashed(acting[:, :-1][learned])
        costs = (temperature * log_prob - action_values(online, judging[:, :-1][learned], action).amin(0)).mean()
        if imitates:
            (place, clear), shape = copied[-1], (85, 6)
            assert clear.shape == shape and not clear[:, :2][place[1][:, 0] > 0].any() and (costs < 0) == imitates
            begins = torch.zeros(shape)
            shown = actor.remember_sequence(told[place], commands.roll(1, 1)[place], actor.initial_hidden(85), begins)
            apart = actor.act(shown[clear]) - commands[place][clear]
            costs = costs + 0.4 * costs.abs() * apart.square().mean()
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


ROWS = 3


def replay(size: int, steps: int) -> Replay:
    """Return a replay of what tells the step it is of and, in tenths, the row."""
    kept = Replay(size, GoToZero(ROWS), 2, torch.device("cpu"))
    for step in range(steps):
        value = step + torch.arange(ROWS) / 10
        nothing = torch.zeros(ROWS, dtype=torch.bool)
        kept.add(
            observation=value[:, None],
            previous_action=-value[:, None],
            hidden=torch.stack([2 * value, 3 * value], dim=-1),
            action=10 * value[:, None],
            reward=100 * value,
            terminated=torch.tensor([step % 5 == 4, False, False]),
            expired=torch.tensor([False, step % 5 == 4, False]),
            first=nothing | (step % 5 == 0),
        )
    return kept


def test_windows_are_steps_in_a_row_of_the_most_recent() -> None:
    kept = replay(ROWS * 12, 40)
    assert len(kept) == 12
    drawn, _ = kept.windows(2000, 4, 0)
    observation = drawn["observation"].squeeze(-1)
    torch.testing.assert_close(observation.diff(dim=1), torch.ones(2000, 4))
    assert sorted(set(observation[:, 0].floor().int().tolist())) == list(range(28, 36))
    assert set((observation[:, 0] % 1 * 10).round().int().tolist()) == {0, 1, 2}
    torch.testing.assert_close(drawn["action"].squeeze(-1), 10 * observation)
    torch.testing.assert_close(drawn["previous_action"].squeeze(-1), -observation)
    torch.testing.assert_close(drawn["hidden"][..., 1], 3 * observation)
    torch.testing.assert_close(drawn["reward"], 100 * observation)


def test_what_is_learned_from_has_a_known_outcome_and_a_filled_memory() -> None:
    kept = replay(ROWS * 100, 60)
    drawn, learned = kept.windows(500, 7, 2)
    for window, (observation, use) in enumerate(zip(drawn["observation"].squeeze(-1), learned, strict=True)):
        begin, row = int(observation[0] + 0.05), round(float(observation[0] % 1) * 10)
        for index in range(7):
            step = begin + index
            known = row != 1 or step % 5 != 4
            filled = index >= 2 or any(seen % 5 == 0 for seen in range(begin, step + 1))
            assert bool(use[index]) == (known and filled), (window, index)


def test_nothing_is_learned_across_a_cut() -> None:
    """Where an episode had ended there, it stays as it was."""
    kept = replay(ROWS * 12, 40)
    before = kept.state_dict()
    expired = torch.as_tensor(before["expired"]).clone()
    kept.cut()
    last = 39 % 12
    expired[last] = ~torch.as_tensor(before["terminated"])[last]
    assert expired[last].any() and not expired[last].all()
    assert torch.equal(torch.as_tensor(kept.state_dict()["expired"]), expired)
    replay(ROWS * 12, 0).cut()
