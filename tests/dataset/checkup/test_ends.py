import numpy as np
import pytest

from astra_data.dataset.checkup.ends import FEW_FAILURES, EpisodeEnds
from astra_data.dataset.columns import TERMINATED, Episode


def episode(uid: int, steps: int, *, terminated: bool | None) -> Episode:
    columns = {"x": np.zeros(steps, np.float32)}
    if terminated is not None:
        columns[TERMINATED] = (np.arange(steps) == steps - 1) & terminated
    return Episode(uid, columns)


def counted(ends: list[tuple[int, bool | None]], successes: list[bool | None] | None) -> EpisodeEnds:
    outcomes = EpisodeEnds(successes)
    for uid, (steps, terminated) in enumerate(ends):
        outcomes.add(episode(uid, steps, terminated=terminated))
    return outcomes


def test_every_way_to_end_is_counted() -> None:
    ends: list[tuple[int, bool | None]] = [
        (9, True),
        (8, True),
        (50, False),
        (50, False),
        (30, False),
        (7, True),
    ]
    outcomes = counted(ends, [True, False, False, None, False, None])
    assert str(outcomes) == (
        "1 in success, 1 in failure, 1 terminated, success unknown, "
        "2 after 50 steps, the longest (a time limit), 1 cut"
    )
    assert outcomes.failures == [1]


def test_a_success_at_the_time_limit_is_a_success() -> None:
    assert str(counted([(50, False), (50, False)], [True, False])) == (
        "1 in success, 1 after 50 steps, the longest (a time limit)"
    )


def test_one_longest_episode_is_no_time_limit() -> None:
    assert str(counted([(9, False), (12, False)], None)) == "2 cut"


def test_of_what_was_not_recorded_nothing_is_told() -> None:
    outcomes = counted([(9, None), (9, None)], None)
    assert str(outcomes).startswith("unknown")
    assert not outcomes.findings()


@pytest.mark.parametrize(("longest", "found"), [(1, True), (2, False)])
def test_episodes_that_all_end_in_their_first_step_are_told(longest: int, found: bool) -> None:
    told = [f"{one}" for one in counted([(1, False), (longest, False)], [None, None]).findings()]
    assert [line.partition(": check what ends them")[0] for line in told] == (
        ["warning: every episode ends after its first step"] if found else []
    )


@pytest.mark.parametrize(("failures", "found"), [(0, False), (1, True), (9, True), (10, False)])
def test_few_failures_are_told(failures: int, found: bool) -> None:
    assert FEW_FAILURES == 10
    ends: list[tuple[int, bool | None]] = [(9, uid < failures) for uid in range(failures + 20)]
    findings = counted(ends, [False] * len(ends)).findings()
    assert [finding.episodes for finding in findings] == ([tuple(range(failures))] if found else [])


def test_where_success_is_unknown_no_failure_is() -> None:
    assert not counted([(9, True)] * 3, None).findings()
