import numpy as np
import pytest

from astra_data.dataset.checkup.commands import GivenCommands, held_steps
from astra_data.dataset.columns import ACTION, Array, Column, Episode


def given(*actions: Array, size: int = 1) -> GivenCommands:
    commands = GivenCommands(Column(ACTION, size=size, names=("v", "w")[:size]), fps=10)
    for uid, action in enumerate(actions):
        commands.add(Episode(uid, {ACTION: action.astype(np.float32)}))
    return commands


def test_commands_are_held_as_long_as_all_of_them_stay() -> None:
    actions = np.array([[0, 0], [0, 0], [0, 0], [0, 1], [2, 1], [2, 1], [3, 3]], np.float32)
    assert held_steps(actions).tolist() == [3, 1, 2]  # the end cuts the last
    assert held_steps(np.ones((4, 2), np.float32)).tolist() == [4]
    assert held_steps(np.ones((1, 2), np.float32)).tolist() == [1]


def test_quantiles_are_over_commands_not_over_steps() -> None:
    values = np.arange(101).repeat([1] * 60 + [2] * 30 + [9] * 10 + [1])
    commands = given(values)
    assert commands.held_s(0.5) == pytest.approx(0.1)
    assert commands.held_s(0.8) == pytest.approx(0.2)
    assert commands.held_s(0.95) == pytest.approx(0.9)


def test_steps_at_either_edge_of_the_range_of_all_episodes_are_counted() -> None:
    first = np.linspace(-0.5, 0.5, 10)  # its edges are none of the whole
    second = np.concatenate([np.linspace(-0.8, 0.8, 8), [-1, 1]])
    third = np.array([1.0] * 5 + [-1.0] * 2 + [0.0] * 3)
    for order in ((first, second, third), (third, first, second)):
        np.testing.assert_allclose(given(*order).edge_shares, [9 / 30])


@pytest.mark.parametrize(("at_edge", "found"), [(20, False), (21, True)])
def test_a_command_is_saturated_above_a_fifth_of_steps(at_edge: int, found: bool) -> None:
    inside = np.linspace(-0.9, 0.9, 100 - at_edge)
    edge = np.where(np.arange(at_edge) % 2, 1.0, -1.0)
    (action,) = [np.concatenate([inside, edge])]
    both = np.column_stack([action, np.linspace(-1, 1, 100)])
    findings = given(both, size=2).findings()
    assert len(findings) == found
    if found:
        assert "up to 21 % of steps, v of action" in findings[0].what


@pytest.mark.parametrize(("values", "found"), [(8, False), (9, True)])
def test_a_choice_of_a_few_commands_has_no_edge(values: int, found: bool) -> None:
    action = np.tile(np.arange(values), 10)
    assert bool(given(action[:40], action[40:]).findings()) == found


def test_a_line_names_the_five_commands_that_are_most_at_the_edge() -> None:
    ramp = np.linspace(-1, 1, 100)
    actions = np.column_stack([ramp.clip(-1, 1 - cut / 10) for cut in (3, 0, 1, 2, 4, 5)])
    commands = GivenCommands(Column(ACTION, size=6), fps=10)
    commands.add(Episode(0, {ACTION: actions.astype(np.float32)}))
    assert str(commands).endswith("0 16.0 %, 2 6.0 %, 3 11.0 %, 4 21.0 %, 5 26.0 % and 1 less often")


def test_a_line_sums_them_up() -> None:
    action = np.column_stack([np.linspace(-1, 1, 20), np.linspace(-1, 1, 20).clip(-0.5, 0.5)])
    shown = str(given(action, size=2))
    assert shown.startswith("held 0.1 s (median), 0.1 s (95 %)")
    assert shown.endswith("v 10.0 %, w 50.0 %")
