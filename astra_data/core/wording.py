"""Lists and long texts in sentences."""

from collections.abc import Sequence


def first_few(words: Sequence[object], most: int) -> str:
    """Name the first `most` of `words` and count the others: `a, b and 3 more`."""
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return ", ".join(map(str, words[:most])) + more


def shortened(text: str, most: int) -> str:
    """Return the first `most` characters of `text`, with an ellipsis where there are more."""
    return text if len(text) <= most else f"{text[:most]}…"
