import copy
import math
from typing import Any

import pytest
import torch
from torch import nn
from toy_worlds import ConstantReward, GoToZero

from astra_data.core.seeding import derive
from astra_data.policies.learner import Learner, lately, penalty_scale, recent
from astra_data.worlds.protocols import BatchedEnv


class Noisy(Learner):
    """Adds noise to a weight, and to the actions that it takes."""

    def __init__(
        self, world: BatchedEnv, iterations: int, seed: int = 3, *, horizon: int = 5, is_staggered: bool = False
    ) -> None:
        self.layer = nn.Linear(1, 1, bias=False)
        nn.init.zeros_(self.layer.weight)
        torch.manual_seed(7)
        super().__init__(
            world,
            torch.zeros(world.num_envs, 2),
            {"layer": self.layer},
            horizon=horizon,
            total_steps=iterations * world.num_envs * 4,
            rollout_steps=4,
            seed=seed,
            is_staggered=is_staggered,
        )

    def _iterate(self) -> dict[str, float]:
        noise = torch.randn(())
        with torch.no_grad():
            self.layer.weight += noise
        for _ in range(self.rollout_steps):
            self.take(torch.randn(self.env.num_envs, 1), self.hidden + 1.0)
        return {"noise": float(noise)}


def world(num_envs: int = 6) -> GoToZero:
    torch.manual_seed(0)
    return GoToZero(num_envs)


@pytest.mark.parametrize(
    ("paces", "shares"),
    [
        ([1.0] * 4, [0.25, 0.5, 0.75, 1.0]),
        ([1.0, 3.0], [0.25, 1.0]),
        ([0.7, 1.2, 1.2, 0.9], [0.175, 0.475, 0.775, 1.0]),  # whose sum is rounded down
        ([0.9, 3.0, 3.0], [0.225, 0.975, 1.0]),
    ],
)
def test_it_ends_after_as_many_steps_as_its_pace_asks_for(paces: list[float], shares: list[float]) -> None:
    learner, found = Noisy(world(), 4), list[float]()
    for number, pace in enumerate(paces, 1):
        assert not learner.done
        learner.pace = pace
        learner.iterate()
        found.append(learner.share)
        assert learner.steps == 24 * number
    assert found == pytest.approx(shares) and learner.done


def test_every_iteration_is_seeded_by_its_number() -> None:
    learner = Noisy(world(), 3)
    for iteration in range(3):
        torch.manual_seed(derive(3, f"iteration {iteration}"))
        expected = float(torch.randn(()))
        torch.manual_seed(99)
        assert learner.iterate()["noise"] == expected
    assert Noisy(world(), 3, seed=4).iterate()["noise"] != Noisy(world(), 3).iterate()["noise"]


def test_resumed_it_does_what_an_uninterrupted_one_does() -> None:
    worlds = [world() for _ in range(3)]
    whole, begun, resumed = (Noisy(one, 4) for one in worlds)
    expected = [whole.iterate() for _ in range(4)]
    begun.pace = 1.5
    found: list[dict[str, Any]] = [begun.iterate(), begun.iterate()]
    state, at = copy.deepcopy(begun.state_dict()), copy.deepcopy(worlds[1].state_dict())
    assert state.keys() == {"layer", "steps", "share", "iteration", "rows"}
    begun.iterate()  # must not reach into what was kept
    resumed.load_state_dict(state, worlds[2].load_state_dict(at))
    assert resumed.steps == 48 and resumed.share == 0.75
    found += [resumed.iterate(), resumed.iterate()]
    assert str(found) == str(expected)  # NaN is never equal
    assert torch.equal(resumed.layer.weight, whole.layer.weight) and torch.equal(resumed.hidden, whole.hidden)


def test_where_the_episodes_cannot_go_on_new_ones_begin() -> None:
    learner = Noisy(world(), 3)
    learner.iterate()
    state = learner.state_dict()
    assert state["rows"]["hidden"].any() and state["rows"]["age"].any()
    resumed, observation = Noisy(world(), 3), torch.full((6, 1), 0.25)
    resumed.load_state_dict(state, observation, goes_on=False)
    rows = resumed.state_dict()["rows"]
    assert resumed.steps == learner.steps and torch.equal(resumed.layer.weight, learner.layer.weight)
    assert torch.equal(resumed.observation, observation) and rows["first"].all()
    assert not any(rows[name].any() for name in ("hidden", "previous_action", "age", "lasted"))
    resumed.load_state_dict(state, observation)
    assert torch.equal(resumed.hidden, state["rows"]["hidden"])


def take(rows: Noisy) -> tuple[torch.Tensor, torch.Tensor]:
    """Take a step too wide; return who expired and who is done."""
    _, action, expired, done = rows.take(torch.full((rows.env.num_envs, 1), 1.5), torch.ones(rows.env.num_envs, 2))
    assert torch.equal(action, torch.ones(rows.env.num_envs, 1))
    return expired, done


@pytest.mark.parametrize(("length", "horizon", "expires"), [(4.0, 9, False), (9.0, 4, True), (4.0, 4, False)])
def test_episodes_end_by_themselves_or_by_the_horizon(length: float, horizon: int, *, expires: bool) -> None:
    rows = Noisy(ConstantReward(2, length), 1, horizon=horizon)
    for step in range(1, 9):
        expired, done = take(rows)
        over = step % 4 == 0
        assert done.tolist() == [over] * 2 and expired.tolist() == [over and expires] * 2
        assert rows.first.tolist() == [over] * 2
        # What an episode before this one did and remembered is gone.
        assert rows.previous_action.squeeze(-1).tolist() == [float(not over)] * 2
        assert rows.hidden.tolist() == [[float(not over)] * 2] * 2
    success = 0.0 if expires else 1.0
    assert rows.figures() == {"success": success, "episode_steps": 4.0, "episodes": 4.0, "reward": 1.0}
    take(rows)
    figures = rows.figures()
    assert figures["episodes"] == 0 and math.isnan(figures["success"]) and math.isnan(figures["episode_steps"])


def test_at_random_ages_not_all_expire_at_once() -> None:
    rows = Noisy(GoToZero(1000), 1, horizon=10, is_staggered=True)
    expired = [int(take(rows)[0].sum()) for _ in range(20)]
    assert min(expired) > 60 and max(expired) < 140 and expired[:10] == expired[10:]
    # The first ones, of 1 to 10 steps, and the second of 10.
    assert rows.figures()["episode_steps"] == pytest.approx(7.75, abs=0.2)


def curve(*successes: float | None) -> list[dict[str, float | None]]:
    """Return points after each tenth of a training."""
    return [{"share": number / 10, "success": success} for number, success in enumerate(successes, 1)]


@pytest.mark.parametrize(
    ("successes", "mean"),
    [([], None), ([None, None], None), ([None, 0.95, None], 0.95), ([0.0, 1.0, 1.0, 1.0, 1.0, 0.5], 0.9)],
)
def test_success_is_the_mean_of_the_last_five_points(successes: list[float | None], mean: float | None) -> None:
    assert recent(curve(*successes)) == (mean and pytest.approx(mean))
    shown = "unknown yet" if mean is None else f"{mean:.2f}"
    assert lately(curve(*successes), "success") == f"success of training episodes {shown}"


@pytest.mark.parametrize(
    ("successes", "scale"),
    [
        ([], 0.0),
        ([0.0, 0.0, None], 0.0),
        ([0.95], 0.4),
        ([1.0, 1.0], 0.8),
        ([1.0, 1.0, 0.7], 0.4),  # a mean of 0.9
        ([1.0, 1.0, 0.7, 0.0, 0.0], 0.0),
        ([1.0, None], 0.8),
        ([1.0] * 8, 1.0),
        ([1.0] * 8 + [0.0, 0.0], 0.6),
        ([0.94] * 3, 0.0),
        ([0.8] * 4, 0.4),  # after two fifths of the training
        ([0.79] * 5, 0.0),
    ],
)
def test_penalties_grow_over_a_quarter_while_episodes_succeed_and_shrink_as_fast(
    successes: list[float | None], scale: float
) -> None:
    assert penalty_scale(curve(*successes), 0.8) == pytest.approx(scale)


def test_at_a_faster_pace_they_grow_with_the_share() -> None:
    points = [{"share": 0.1, "success": 1.0}, {"share": 0.225, "success": 1.0}]
    assert penalty_scale(points, 0.8) == pytest.approx(0.9)
    assert penalty_scale(curve(*[0.7] * 5), 0.7) == pytest.approx(0.8)
