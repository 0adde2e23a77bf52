import copy
from typing import Any

import pytest
import torch
from torch import nn
from toy_worlds import GoToZero

from astra_data.core.seeding import derive
from astra_data.policies.learner import Acting, Learner


class Noisy(Learner):
    """Adds noise to a weight, and to the actions that it takes."""

    def __init__(self, world: GoToZero, iterations: int, seed: int = 3) -> None:
        self.layer = nn.Linear(1, 1, bias=False)
        nn.init.zeros_(self.layer.weight)
        torch.manual_seed(7)
        super().__init__(
            Acting(world, torch.zeros(world.num_envs, 2), horizon=5, is_staggered=False),
            {"layer": self.layer},
            total_steps=iterations * world.num_envs * 4,
            rollout_steps=4,
            seed=seed,
        )

    def _iterate(self) -> dict[str, float]:
        noise = torch.randn(())
        with torch.no_grad():
            self.layer.weight += noise
        for _ in range(self.rollout_steps):
            self.acting.take(torch.randn(self.env.num_envs, 1), self.acting.hidden + 1.0)
        return {"noise": float(noise)}


def world(num_envs: int = 6) -> GoToZero:
    torch.manual_seed(0)
    return GoToZero(num_envs)


@pytest.mark.parametrize(
    ("paces", "shares"),
    [
        ([1.0] * 4, [0.25, 0.5, 0.75, 1.0]),
        ([1.0, 3.0], [0.25, 1.0]),
        ([2.0, 1.0, 1.0], [0.5, 0.75, 1.0]),
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
        assert learner.steps == 24 * number and learner.share_left == pytest.approx(1.0 - learner.share)
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
    assert state.keys() == {"layer", "steps", "share", "iteration", "acting"}
    begun.iterate()  # must not reach into what was kept
    resumed.load_state_dict(state, worlds[2].load_state_dict(at))
    assert resumed.steps == 48 and resumed.share == 0.75
    found += [resumed.iterate(), resumed.iterate()]
    assert found == expected
    assert torch.equal(resumed.layer.weight, whole.layer.weight)
    assert torch.equal(resumed.acting.hidden, whole.acting.hidden)


def test_where_the_episodes_cannot_go_on_new_ones_begin() -> None:
    learner = Noisy(world(), 3)
    learner.iterate()
    state = learner.state_dict()
    assert state["acting"]["hidden"].any() and state["acting"]["age"].any()
    resumed, observation = Noisy(world(), 3), torch.full((6, 1), 0.25)
    resumed.load_state_dict(state, observation, goes_on=False)
    acting = resumed.acting.state_dict()
    assert resumed.steps == learner.steps and torch.equal(resumed.layer.weight, learner.layer.weight)
    assert torch.equal(resumed.acting.observation, observation) and acting["first"].all()
    assert not any(acting[name].any() for name in ("hidden", "previous_action", "age", "lasted"))
    resumed.load_state_dict(state, observation)
    assert torch.equal(resumed.acting.hidden, state["acting"]["hidden"])
