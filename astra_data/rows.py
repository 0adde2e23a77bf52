"""Rows of the results: a method by its name, or followed by `_plus`, trained with the `[plus]` settings."""

PLUS = "_plus"


def is_plus(row: str) -> bool:
    """Tell whether a row is the variant of its method."""
    return row.endswith(PLUS)


def base_method(row: str) -> str:
    """Return the name of a row's method: `astra` of "astra" and of "astra_plus"."""
    return row.removesuffix(PLUS)
