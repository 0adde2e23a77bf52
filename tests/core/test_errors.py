from astra_data.core.errors import first_line


def test_the_first_line_of_an_error_is_short_and_printable() -> None:
    shown = first_line(ValueError(f"Expected 2 columns, got 1: \x1b[2J\0{'x' * 5000}\nand more"))
    assert shown.startswith("Expected 2 columns, got 1: ")
    assert shown.isprintable() and len(shown) < 400
