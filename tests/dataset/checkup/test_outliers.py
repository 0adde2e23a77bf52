import numpy as np
import pytest

from astra_data.dataset.checkup.outliers import Outliers
from astra_data.dataset.columns import REWARD, STATE, TERMINATED, Array, Column, Episode

POSE = Column(STATE, size=2, names=("x", "y"))


def found(
    lengths: list[int],
    *,
    returns: list[float] | None = None,
    reach: list[float] | None = None,
    terminated: list[bool] | None = None,
    successes: list[bool | None] | None = None,
) -> list[str]:
    """List reasons, each after its uid, of episodes of these lengths and returns, where x reaches `reach`."""
    outliers = Outliers(None if reach is None else POSE, successes)
    for uid, steps in enumerate(lengths):
        columns: dict[str, Array] = {"other": np.zeros(steps, np.float32)}
        if returns is not None:
            columns[REWARD] = np.full(steps, returns[uid] / steps, np.float32)
        if reach is not None:
            columns[STATE] = np.linspace([0, 0], [reach[uid], 1], steps).astype(np.float32)
        if terminated is not None:
            columns[TERMINATED] = (np.arange(steps) == steps - 1) & terminated[uid]
        outliers.add(Episode(uid, columns))
    return [
        name for finding in outliers.findings("walks") for name in finding.what.partition(": ")[2].split("; ")
    ]


# Of equal lengths the logarithm has a scale of 0.1: 100 / exp(0.8) is 44.9, and 100 * exp(0.8) is 222.6.
@pytest.mark.parametrize(("steps", "is_far"), [(44, True), (45, False), (222, False), (223, True)])
def test_lengths_are_compared_as_logarithms(steps: int, is_far: bool) -> None:
    assert found([100] * 20 + [steps]) == [f"20 by length {steps} steps, median 100"] * is_far


def test_lengths_that_vary_are_measured_by_their_deviation() -> None:
    varied = [
        25,
        50,
        100,
        200,
        400,
    ] * 5  # the logarithm deviates by log 2: 8 robust deviations are a factor of 3700
    assert not found([*varied, 1])
    assert not found([*varied, 9000])


@pytest.mark.parametrize(("count", "is_far"), [(8, False), (9, True)])
def test_among_nine_episodes_none_is_far(count: int, is_far: bool) -> None:
    assert bool(found([100] * count + [10])) is is_far


def test_episodes_are_compared_with_those_that_end_alike() -> None:
    # Falls come early; a short episode among those of the time limit is another matter.
    lengths, falls = [100] * 15 + [10] * 15, [False] * 15 + [True] * 15
    assert not found(lengths, terminated=falls)
    assert found([*lengths, 10], terminated=[*falls, False])
    assert not found(lengths, successes=[not fall for fall in falls])


# Returns -2, ..., 2 deviate by 1 in the median: 8 robust deviations are 11.86.
@pytest.mark.parametrize(("reward", "is_far"), [(11.7, False), (12.0, True), (-12.0, True)])
def test_returns_are_measured_by_their_deviation(reward: float, is_far: bool) -> None:
    spread = [-2.0, -1.0, 0.0, 1.0, 2.0]
    names = found([50] * 51, returns=[*spread * 10, reward])
    assert names == [f"50 by return {reward:.4g}, median 0"] * is_far


# Of 41 episodes 95 % reach no more than 12, from 0 on: that is their range, and 24 is beyond by its width.
@pytest.mark.parametrize(("reach", "is_far"), [(23.9, False), (24.1, True), (-11.9, False), (-12.1, True)])
def test_a_state_is_far_beyond_twice_the_range_of_the_others(reach: float, is_far: bool) -> None:
    others = [8.0, 9.0, 10.0, 11.0, 12.0] * 8
    names = found([50] * 41, reach=[*others, reach])
    assert [
        name.startswith(f"40 by x of observation.state, which reaches {reach:.4g}") for name in names
    ] == ([True] * is_far)


# Reaching 0, 1, ..., 39 and one more deviates by 10 in the median: 8 robust deviations from 20 are 138.6.
@pytest.mark.parametrize(("reach", "is_far"), [(138.0, False), (139.0, True)])
def test_a_state_that_varies_is_measured_by_its_deviation(reach: float, is_far: bool) -> None:
    assert bool(found([50] * 41, reach=[*map(float, range(40)), reach])) is is_far


def test_a_state_that_others_vary_in_far_more_than_in_each_is_none() -> None:
    # Robots that go to many places.
    assert not found([50] * 41, reach=[float(index**2) for index in range(41)])


def test_a_value_that_changed_in_one_episode_alone_has_nothing_to_be_compared_with() -> None:
    assert not found([50] * 41, reach=[0.0] * 40 + [5.0])


def test_five_reasons_are_spelled() -> None:
    names = found([100] * 60 + [10] * 7)
    assert [name.split()[0] for name in names] == ["60", "61", "62", "63", "64"]
