import pytest

from astra_data.training.ramp import Ramp

STEPS = 100


def curve(*successes: float | None) -> list[dict[str, float | None]]:
    return [{"steps": 10.0 * number, "success": success} for number, success in enumerate(successes, 1)]


def scale(ramp: Ramp, *successes: float | None) -> float:
    return ramp.scale(curve(*successes), 10 * len(successes), STEPS)


def test_without_a_share_penalties_are_whole() -> None:
    assert Ramp(0.0).scale([], 0, STEPS) == 1.0


def test_a_plain_ramp_asks_for_no_success() -> None:
    assert scale(Ramp(0.4), 0.0, None) == pytest.approx(0.5)
    assert scale(Ramp(0.4), *[0.0] * 9) == 1.0


def test_penalties_grow_with_success_and_shrink_as_fast_without() -> None:
    ramp = Ramp(0.5, 0.9)
    assert scale(ramp, 1.0, 1.0) == pytest.approx(0.4)
    assert scale(ramp, 1.0, 1.0, 0.5) == pytest.approx(0.2)  # a mean of 0.83
    assert scale(ramp, 1.0, 1.0, 0.5, 0.0, 0.0) == 0.0
    assert scale(ramp, 0.9) == pytest.approx(0.2)


def test_they_begin_only_once_there_is_success_to_lose() -> None:
    ramp = Ramp(0.5, 0.9)
    assert scale(ramp, 0.0, 0.0, None, None) == 0.0
    # Five points back there was none yet; those without an episode do not count.
    assert scale(ramp, 0.0, 1.0, 1.0, None, None, 1.0) == pytest.approx(0.2)


def test_they_never_exceed_one() -> None:
    assert scale(Ramp(0.5, 0.9), *[1.0] * 8) == 1.0
    assert scale(Ramp(0.5, 0.9), *[1.0] * 8, *[0.0] * 2) == pytest.approx(0.6)
