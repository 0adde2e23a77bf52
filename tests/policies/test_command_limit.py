"""The limit of commands, on steps whose failures are placed by hand."""

from dataclasses import replace

import pytest
import torch
from toy_episodes import toy_episodes

from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.policies.simulator_env import command_limit
from astra_data.robots.registry import TASKS
from astra_data.worlds.objective import NO_LIMIT

TASK = TASKS["antmaze-umaze"]
SHORT, LONG = 0.8, 1.4
"""Lengths of commands, kept through an episode."""


def recorded(failing: dict[float, int], lengths: tuple[float, ...] = (SHORT, LONG)) -> PairedEpisodes:
    """Return 40 episodes of 30 steps for each length of commands, of which so many fail."""
    length = torch.tensor(lengths).repeat_interleave(40)[:, None].expand(-1, 30)
    angle = torch.linspace(0.0, 3.0, 30).expand_as(length)
    action = torch.stack([length * angle.cos(), length * angle.sin()], dim=-1)
    fails = torch.cat([torch.arange(40) < failing.get(one, 0) for one in lengths])
    state = torch.tensor([-4.0, 4.0, 0.0, 0.0]).expand(len(fails), 30, 4)
    made = toy_episodes(state, action, next_state=state, goal=torch.zeros(len(fails), 30, 2))
    soon = (fails[:, None] & (torch.arange(30) >= 10)).float()
    return replace(made, windows=replace(made.windows, fails_soon=soon))


@pytest.mark.parametrize(
    ("failing", "lengths", "expected"),
    [
        ({}, (SHORT, LONG), NO_LIMIT),
        ({LONG: 12}, (SHORT, LONG), 1.0),
        ({SHORT: 4, LONG: 7}, (SHORT, LONG), 1.0),
        ({SHORT: 4, LONG: 5}, (SHORT, LONG), NO_LIMIT),
        ({SHORT: 12}, (SHORT, LONG), NO_LIMIT),
        ({SHORT: 12}, (SHORT,), NO_LIMIT),
        ({LONG: 1}, (LONG,), 1.0),
    ],
)
def test_it_is_one_where_failures_are_half_as_frequent_again_above(
    failing: dict[float, int], lengths: tuple[float, ...], expected: float
) -> None:
    assert command_limit(TASK, recorded(failing, lengths)) == expected


def test_commands_of_the_last_second_count() -> None:
    """Commands that were long until 20 steps before a failure are no part of it."""
    whole = recorded({LONG: 12})
    windows, late = whole.windows, torch.arange(30)[:, None] >= 10
    gone = replace(windows, action=torch.where(late, windows.action * 0.5 / LONG, windows.action))
    assert command_limit(TASK, replace(whole, windows=gone)) == NO_LIMIT
