from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from small_cart import TASK
from toy_corrections import OFFSETS_M, shifted

from astra_data.core.errors import BadInputError
from astra_data.grounding.committee import Committee, Rollouts
from astra_data.grounding.history import HistoryGrounding
from astra_data.training import proposals
from astra_data.training.proposals import SuggestConfig, chosen, drawn, planned, suggested
from astra_data.worlds.registry import TASKS

CONFIG = SuggestConfig(episodes=3, max_steps=10, start="task", hold_s=(0.2, 0.4), proposals=16)


def test_the_most_instructive_is_taken_first_and_the_next_one_elsewhere() -> None:
    """The second best passes where the best does, the third does not; one far away teaches in full."""
    information = torch.tensor([[1.0, 1.0], [3.0, 3.0], [2.9, 2.9], [2.0, 2.0]])
    places = torch.tensor([[0.0, 0.1], [5.0, 5.1], [5.0, 5.1], [90.0, 90.0]])[..., None]
    taken, gained = chosen(information, places, 3, reach=0.5)
    assert taken.tolist() == [1, 3, 0]
    assert gained == pytest.approx([6.0, 4.0, 2.0])


def test_at_its_reach_a_step_teaches_two_fifths() -> None:
    places = torch.tensor([[0.0, 0.0], [0.7, 0.7]])[..., None]
    _, gained = chosen(torch.full((2, 2), 2.0), places, 2, reach=0.7)
    assert gained == pytest.approx([4.0, 4.0 * (1 - np.exp(-0.5))])


def test_equal_commands_in_a_row_are_held() -> None:
    action = torch.tensor([[-1.0], [-1.0], [1.0], [-1.0]])
    one = planned(TASK, torch.tensor([0.5]), action, 2.0)
    assert one.start == (0.5,) and one.information == 2.0
    assert one.commands == ((-1.0,), (4.0,), (-1.0,)) and one.hold_steps == (2, 1, 1)


def test_proposals_are_drawn_as_episodes_are_collected() -> None:
    first, again, other = (drawn(TASK, CONFIG, seed) for seed in (1, 1, 2))
    assert first.action.shape == (10, 16, 1) and first.start.tolist() == [[0.0]] * 16
    assert (first.goal >= 1.0).all() and (first.goal <= 2.0).all()
    torch.testing.assert_close(first.action, again.action)
    assert (first.action != other.action).any() and (first.goal != other.goal).any()
    for commands in first.action[..., 0].T:
        held = np.diff(np.flatnonzero(np.diff(commands, prepend=np.nan, append=np.nan) != 0))
        assert set(held[:-1]) <= {2, 3, 4}


def test_the_shorter_hold_comes_first() -> None:
    with pytest.raises(ValidationError, match=r"expected the lower end first, got \[3\.0, 0\.5\]"):
        SuggestConfig(hold_s=(3.0, 0.5))


def test_starts_are_anywhere_in_a_maze_and_only_there() -> None:
    maze = TASKS["antmaze-umaze"]
    anywhere = drawn(maze, CONFIG.model_copy(update={"start": "anywhere"}), 0).start
    assert (drawn(maze, CONFIG.model_copy(update={"start": "anywhere"}), 1).start != anywhere).any()
    usual = drawn(maze, CONFIG, 0).start
    assert anywhere[:, :2].std(0).min() > 2 * usual[:, :2].std(0).max()
    with pytest.raises(BadInputError, match="expected a task in a maze"):
        drawn(TASK, CONFIG.model_copy(update={"start": "anywhere"}), 0)


def test_what_a_simulator_draws_is_of_the_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a ball may start to roll."""
    committee = Committee.of(TASK, [HistoryGrounding(shifted(*OFFSETS_M))])
    follow = Committee.follow

    def drawn_too(self: Committee, *given: Any) -> Rollouts:  # noqa: ANN401 - handed on
        known = follow(self, *given)
        return replace(known, information=torch.rand_like(known.information))

    monkeypatch.setattr(Committee, "follow", drawn_too)
    first = suggested(TASK, committee, CONFIG, seed=1)
    torch.rand(3)
    assert suggested(TASK, committee, CONFIG, seed=1).taken.tolist() == first.taken.tolist()


@pytest.mark.parametrize("steps", [10, 13])
def test_steps_are_compared_every_half_second_in_standard_deviations(
    monkeypatch: pytest.MonkeyPatch, steps: int
) -> None:
    """Steps between those that are compared, and after the last one, count with them."""
    committee, given = Committee.of(TASK, [HistoryGrounding(shifted(*OFFSETS_M))]), list[Any]()

    def noted(*them: Any) -> Any:  # noqa: ANN401 - handed on
        given.extend(them)
        return chosen(*them)

    monkeypatch.setattr(proposals, "chosen", noted)
    made = suggested(TASK, committee, CONFIG.model_copy(update={"max_steps": steps}), seed=1)
    every = torch.cat([made.rollouts.state, made.proposals.action], dim=-1)
    compared = range(0, steps, 5)  # of steps of 0.1 s
    expected = every[[*compared]] / every.flatten(0, 1).std(0)
    torch.testing.assert_close(given[1], expected.transpose(0, 1))
    blocks = [made.rollouts.expected[first : first + 5].sum(0) for first in compared]
    torch.testing.assert_close(given[0], torch.stack(blocks, dim=1))
    assert (made.rollouts.reached == 0).any()
    assert made.information.max() == pytest.approx(float(given[0].sum(1).max()))


def test_a_suggestion_is_what_was_taken_of_the_proposals() -> None:
    committee = Committee.of(TASK, [HistoryGrounding(shifted(*OFFSETS_M))])
    made = suggested(TASK, committee, CONFIG, seed=1)
    torch.testing.assert_close(
        made.plan.actions(TASK), made.proposals.action[:, made.taken], atol=1e-6, rtol=0
    )
    assert made.plan.task == "rail-cart" and len(set(made.taken.tolist())) == 3
    worth = (made.rollouts.information * made.rollouts.reached).sum(0)
    assert made.taken[0] == worth.argmax() and made.information[0] == pytest.approx(float(worth.max()))
    assert (np.diff(made.information) <= 0).all()
    with pytest.raises(BadInputError, match="expected at most 16, the proposals, got 17"):
        suggested(TASK, committee, CONFIG.model_copy(update={"episodes": 17}), seed=1)


def test_what_teaches_nothing_is_taken_once_all_the_same() -> None:
    taken, gained = chosen(torch.zeros(3, 1), torch.zeros(3, 1, 1), 3, reach=0.5)
    assert sorted(taken.tolist()) == [0, 1, 2] and gained.tolist() == [0.0] * 3


def test_a_step_teaches_as_much_as_the_nearest_leaves_of_it() -> None:
    """The third lies between the others, as far from either as their reach."""
    information, places = torch.tensor([[10.0], [9.0], [1.0]]), torch.tensor([[-0.5], [0.5], [0.0]])
    taken, gained = chosen(information, places[..., None], 3, reach=0.5)
    assert taken.tolist() == [0, 1, 2] and gained[2] == pytest.approx(1 - np.exp(-0.5))


def test_a_copy_of_a_long_way_teaches_nothing() -> None:
    places = torch.tensor([[0.0, 5.0]]).expand(2, 2)[..., None]
    assert chosen(torch.ones(2, 2), places, 2, reach=0.5)[1] == pytest.approx([2.0, 0.0])


def test_what_never_varies_tells_no_proposals_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    committee, follow = Committee.of(TASK, [HistoryGrounding(shifted(*OFFSETS_M))]), Committee.follow

    def still(self: Committee, *given: Any) -> Rollouts:  # noqa: ANN401 - handed on
        known = follow(self, *given)
        return replace(known, state=torch.zeros_like(known.state))

    monkeypatch.setattr(Committee, "follow", still)
    made = suggested(TASK, committee, CONFIG, seed=1)
    assert np.isfinite(made.information).all() and (made.information > 0).all()


def test_progress_is_of_the_rollouts_first_and_of_the_choice_then() -> None:
    committee, told = Committee.of(TASK, [HistoryGrounding(shifted(*OFFSETS_M))]), list[float]()
    suggested(TASK, committee, CONFIG, seed=1, progress=lambda done, note: told.append(done))
    assert len(told) == 10 + 3 and told == sorted(told)
    assert told[9:] == pytest.approx([0.9, 0.9 + 0.1 / 3, 0.9 + 0.2 / 3, 1.0])
