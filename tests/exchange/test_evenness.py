"""Whether rows at fps take messages evenly, and what is proposed where they do not."""

import re

import numpy as np
import pytest

from astra_data.exchange.evenness import dropouts, ended, uneven_steps


def odd_share(rate: float, fps: int) -> float:
    """Return the share of the steps between rows that have not as many messages as most, counted out."""
    messages = np.floor(rate / fps * np.arange(10_000) + 1e-6)
    counts = np.unique(np.diff(messages), return_counts=True)[1]
    return float(1 - counts.max() / counts.sum())


@pytest.mark.parametrize(
    ("rate", "fps", "steps", "proposed"),
    [
        (30, 20, "33 and 67", "10, 15 or 30"),
        (29.98, 20, "33 and 67", "10, 15 or 30"),
        (50, 20, "40 and 60", "10, 25 or 50"),
        (250, 100, "8 and 12", "50, 125 or 250"),
        (31, 20, "32 and 65", "31"),
    ],
)
def test_rates_that_divide_are_proposed(rate: float, fps: int, steps: str, proposed: str) -> None:
    assert uneven_steps("/odom", rate, fps) == (
        f"/odom comes {round(rate)} times a second, of which {fps} fps is no whole fraction: "
        f"steps of {steps} ms alternate; take {proposed}"
    )
    assert odd_share(round(rate), fps) > 0.05
    for each in re.findall("[0-9]+", proposed):
        assert odd_share(round(rate), int(each)) == 0


@pytest.mark.parametrize(("rate", "fps"), [(28.7, 20), (28.7, 10), (103, 20), (12.5, 10)])
def test_where_no_rate_divides_the_spread_is_told_and_the_rate_that_divides_best(
    rate: float, fps: int
) -> None:
    told = uneven_steps("/odom", rate, fps)
    match = re.search(
        r"at (\d+), (\d+)% .* of (\d+) ms, the others of (\d+); at (\d+) only (\d+)% are odd", told
    )
    assert match is not None, told
    at, percent, long, short, best, odd = map(int, match.groups())
    share = rate / fps % 1
    assert at == fps and percent == round(100 * share)
    assert long - short == pytest.approx(1000 / rate, abs=1.1)
    assert odd_share(rate, best) == pytest.approx(odd / 100, abs=0.006)
    assert odd_share(rate, best) < 0.05 < odd_share(rate, fps)
    assert "no fps nearby is a whole fraction" in told


@pytest.mark.parametrize(
    ("rate", "fps"), [(50, 10), (49.9, 10), (20, 20), (20.2, 20), (30, 40), (20, 40), (0.4, 1), (400, 30)]
)
def test_even_steps_are_not_told(rate: float, fps: int) -> None:
    """Nor rows that repeat messages, nor steps of which one is 13 messages long and the next 14."""
    assert uneven_steps("/odom", rate, fps) == ""


def test_a_dropout_is_told_with_its_column() -> None:
    assert dropouts("/odom", "observation.state", 20.0, 20, [250_000_000], 2) == (
        "/odom is silent for up to 0.25 s once, where 2 rows repeat its message before: "
        'gap_s = 0.1 in [columns."observation.state"] ends episodes there'
    )
    told = dropouts("/imu", "observation.imu", 100.0, 10, [250_000_000, 150_000_000], 1)
    assert told.startswith(
        "/imu is silent for up to 0.25 s in 2 places, where a row repeats its message before"
    )
    assert 'gap_s = 0.09 in [columns."observation.imu"]' in told


@pytest.mark.parametrize("column", ["", "action", "observation.state"])
@pytest.mark.parametrize("commanded", [None, "action"])
def test_a_silence_that_ends_episodes_is_told_with_its_key_and_what_it_may_mean(
    column: str, commanded: str | None
) -> None:
    """A column with a gap of its own cannot be latched; a base's watchdog stops it without commands."""
    told = ended("/cmd_vel", 2, 0.5, column, commanded)
    key = f'gap_s in [columns."{column}"]' if column else "split.gap_s"
    assert told.startswith(f"/cmd_vel is silent for over 0.5 s ({key}) 2 times while others are not; ")
    assert ("is right if the robot stops by itself" in told) is (commanded is not None)
    assert ("latched = true" in told) is (not column)
    assert "set a longer" in told or "or a longer gap_s" in told


def test_silences_once_are_not_counted() -> None:
    assert "(split.gap_s) once while" in ended("/odom", 1, 0.5, "", None)
