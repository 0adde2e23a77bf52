import pytest

from astra_data.policies.learner import is_mastered, penalty_scale


def curve(*successes: float | None) -> list[dict[str, float | None]]:
    """Return points after each tenth of a training."""
    return [{"share": number / 10, "success": success} for number, success in enumerate(successes, 1)]


@pytest.mark.parametrize(
    ("successes", "mastered"),
    [
        ([], False),
        ([None, None], False),
        ([0.95], True),
        ([0.94], False),
        ([None, 0.95, None], True),
        ([0.0, 1.0, 1.0, 1.0, 1.0, 1.0], True),  # five points back there was none yet
        ([0.0, 1.0, 1.0, 1.0, 1.0], False),
    ],
)
def test_a_simulator_is_mastered_by_the_mean_of_the_last_five_points(
    successes: list[float | None], mastered: bool
) -> None:
    assert is_mastered(curve(*successes)) == mastered


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
        ([1.0] * 8 + [0.0], 0.6),
    ],
)
def test_penalties_grow_over_a_quarter_while_it_is_mastered_and_shrink_as_fast(
    successes: list[float | None], scale: float
) -> None:
    assert penalty_scale(curve(*successes)) == pytest.approx(scale)


def test_at_a_faster_pace_they_grow_with_the_share() -> None:
    points = [{"share": 0.1, "success": 1.0}, {"share": 0.225, "success": 1.0}]
    assert penalty_scale(points) == pytest.approx(0.9)
