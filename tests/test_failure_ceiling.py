import numpy as np
import pytest
import torch
from failure_ceiling import NEVER, BranchingCommands, Recorded, ceilings, failures_after, main, recorded

from astra_data.worlds.registry import task_named

TASK = task_named("antmaze-long")


@pytest.fixture(scope="module")
def episodes() -> tuple[BranchingCommands, Recorded]:
    behavior = BranchingCommands(2, (10, 60))
    return behavior, recorded(TASK, behavior, seed=1, episodes=20, steps=120, every=2)


def test_futures_go_on_from_the_very_state(episodes: tuple[BranchingCommands, Recorded]) -> None:
    behavior, kept = episodes
    assert kept.failed.sum() == 1
    moments = kept.chosen(safe=3, seed=0)
    assert [moment.ahead for moment in moments[-3:]] == [NEVER] * 3
    # The ant is deterministic: what fails before its command changes fails at the recorded step.
    decided = [moment for moment in moments if moment.ahead <= moment.held]
    assert len({moment.ahead for moment in decided}) > 2
    for moment, fails in zip(decided, failures_after(TASK, behavior, decided, 3, seed=0), strict=True):
        assert fails.tolist() == [moment.ahead] * 3


def test_commands_are_held_on_and_then_new() -> None:
    behavior, nothing = BranchingCommands(2, (10, 60)), torch.zeros(3, 1)
    acted = []
    for seed in (0, 0, 1):
        going_on = behavior.continued(np.array([0.25, -0.5]), held=2, futures=3, seed=seed)
        acted.append(torch.stack([going_on.act(nothing, nothing) for _ in range(4)]))
    held, new = acted[0][:2], acted[0][2]
    assert (held == torch.tensor([0.25, -0.5])).all()
    assert len(new.unique(dim=0)) == 3 and (acted[0][3] == new).all()
    assert (acted[1] == acted[0]).all() and not (acted[2][2] == new).any()


def test_moments_are_those_before_failures_and_some_safe_ones(
    episodes: tuple[BranchingCommands, Recorded],
) -> None:
    _, kept = episodes
    (failing,) = np.flatnonzero(kept.failed)
    length = kept.lengths[failing]
    aheads = [moment.ahead for moment in kept.chosen(safe=0, seed=0)]
    assert aheads == [length - step for step in range(0, length, 2) if length - step <= 40]
    assert len(kept.chosen(safe=10**6, seed=0)) == sum(-(-kept.lengths // 2))


def test_odds_rank_moments_by_window() -> None:
    fails = np.array([[5, 5, NEVER], [25, 25, NEVER], [NEVER, NEVER, NEVER], [5, 5, NEVER]])
    assert ceilings(fails, np.array([3, 25, NEVER, NEVER])) == [0.75, 1.0, 1.0]
    assert ceilings(fails, np.array([3, NEVER, NEVER, NEVER]))[1:] == [None, None]


def test_a_line_for_half_of_the_futures_and_for_all(capsys: pytest.CaptureFixture[str]) -> None:
    main("antmaze-long", [1], episodes=4, steps=10, clearance=0.5, every=5, safe=2, futures=4)
    assert capsys.readouterr().out.splitlines() == [
        "| seed | failures | moments | futures | 1-20 | 11-30 | 21-40 |",
        "|---|---|---|---|---|---|---|",
        "| 1 | 0 | 2 | 2 | - | - | - |",
        "| 1 | 0 | 2 | 4 | - | - | - |",
    ]
