"""Lists in sentences."""

from astra_data.core.wording import first_few, shortened


def test_as_many_as_are_shown_are_all_named() -> None:
    """The last that fits isn't counted."""
    assert first_few(["a", "b", "c"], 3) == "a, b, c"


def test_others_are_counted() -> None:
    """Numbers are named as they are."""
    assert first_few((3, 1, 4, 1, 5), 2) == "3, 1 and 3 more"


def test_of_nothing_nothing_is_said() -> None:
    """No separator stands alone."""
    assert first_few([], 2) == ""


def test_a_long_text_is_cut_and_says_so() -> None:
    """One that fits stays as it is."""
    assert shortened("grounding", 9) == "grounding"
    assert shortened("grounding", 8) == "groundin…"
