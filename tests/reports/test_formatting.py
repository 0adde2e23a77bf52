import numpy as np
import pytest
from jinja2 import UndefinedError

from astra_data.reports.formatting import (
    duration,
    fill,
    inline,
    interval,
    mean_std,
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


def test_spread_is_that_of_a_sample() -> None:
    assert mean_std([0.1, 0.2, 0.6], 3) == f"0.300 ± {np.std([0.1, 0.2, 0.6], ddof=1):.3f}"
    assert mean_std([0.25], 1) == "0.2"
    assert spread(Summary(0.5, 0.25, 0.4, 0.1, 0.9), 2) == "0.50 ± 0.25"
    assert spread(Summary(0.5, None, 0.4, None, None), 0) == "0"


def test_a_value_without_an_interval_stands_alone() -> None:
    assert interval(0.5, 0.125, 1.0) == "0.50 [0.12, 1.00]"
    assert interval(61.6, 60.4, 70.0, 0) == "62 [60, 70]"
    assert interval(0.5, None, None, 1) == interval(0.5, None, 1.0, 1) == "0.5"


def test_a_measured_value_has_three_digits() -> None:
    assert measured(0.12345, 0.1, 1234.5) == "0.123 [0.1, 1.23e+03]"
    assert measured(0.12345, None, None) == "0.123"


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


def test_what_a_template_lacks_is_an_error_and_markdown_is_not_escaped() -> None:
    with pytest.raises(UndefinedError, match="found"):
        fill("sizes.md.jinja")
    made = {"code": "a & b", "machine": "<x>", "versions": "'1'"}
    assert fill("origin.md.jinja", made=made).strip() == ""


def test_a_sentence_of_markdown_is_escaped_before_it_is_marked() -> None:
    assert str(inline("**Of** `a<b` & *c*")) == "<strong>Of</strong> <code>a&lt;b</code> &amp; *c*"
    assert str(inline("`<script>`: <b>")) == "<code>&lt;script&gt;</code>: &lt;b&gt;"
