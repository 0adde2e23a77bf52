import numpy as np
import pytest

from astra_data.reports.formatting import (
    duration,
    interval,
    listed,
    measured,
    short,
    spread,
    table,
)
from astra_data.reports.statistics import Summary


def test_columns_of_words_are_aligned_left_and_of_numbers_right() -> None:
    assert table(["a", "b", "c"], [["x", "1", "2"], ["y", "3", "4"]]) == (
        "| a | b | c |\n| --- | ---: | ---: |\n| x | 1 | 2 |\n| y | 3 | 4 |"
    )
    assert table(["a", "b", "c"], [], words=2).endswith("| --- | --- | ---: |")


def test_spread_is_mean_and_standard_deviation() -> None:
    assert spread(Summary(0.5, 0.25, 0.1, 0.9, 3), 2) == "0.50 ± 0.25"
    assert spread(Summary(0.5, None, None, None, 1), 0) == "0"
    assert spread(None, 2) == "-"


def test_words_are_listed_as_in_a_sentence() -> None:
    assert [listed(list("abc")[:count]) for count in (0, 1, 2, 3)] == ["", "a", "a and b", "a, b and c"]


def test_a_value_without_an_interval_stands_alone() -> None:
    assert interval(0.5, 0.125, 1.0) == "0.50 [0.12, 1.00]"
    assert interval(61.6, 60.4, 70.0, 0) == "62 [60, 70]"
    assert interval(0.5, None, None, 1) == interval(0.5, None, 1.0, 1) == "0.5"


def test_a_measured_value_has_three_digits() -> None:
    assert measured(0.12345, 0.1, 1234.5) == "0.123 [0.1, 1.23e+03]"
    assert measured(0.12345, np.nan, np.nan) == "0.123"


@pytest.mark.parametrize(
    ("rate", "text"),
    [
        *((0.01234, "0.0123"), (999.4, "999"), (999.7, "1 k"), (1000, "1 k"), (123456, "123 k")),
        *((999_400, "999 k"), (999_600, "1 M"), (1_234_567, "1.23 M")),
    ],
)
def test_rates_have_three_digits(rate: float, text: str) -> None:
    assert short(rate) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (None, "-"),
        (0, "0 s"),
        (99, "99 s"),
        (100, "2 min"),
        (5399, "90 min"),
        (5400, "1.5 h"),
        (36000, "10.0 h"),
    ],
)
def test_times_are_in_a_unit_that_suits_them(seconds: float | None, text: str) -> None:
    assert duration(seconds) == text
