import pytest

from astra_data.core.errors import in_short


def test_the_first_line_of_an_error_is_short_and_printable() -> None:
    shown = in_short(ValueError(f"Expected 2 columns, got 1: \x1b[2J\0{'x' * 5000}\nand more"))
    assert shown.startswith("Expected 2 columns, got 1: ") and shown.isprintable() and len(shown) < 400


@pytest.mark.parametrize("message", ["One two. Three", "One two\nthree", "One two.", "One two:\nthree. Four"])
def test_only_the_first_sentence_is_shown(message: str) -> None:
    assert in_short(ValueError(message)) == "One two"
