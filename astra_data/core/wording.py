"""Lists, long texts and names of strangers in sentences."""

import html
import re
from collections.abc import Sequence


def first_few(words: Sequence[object], most: int) -> str:
    """Name the first `most` of `words` and count the others: `a, b and 3 more`."""
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return ", ".join(map(str, words[:most])) + more


def shortened(text: str, most: int) -> str:
    """Return the first `most` characters of `text`, with an ellipsis where there are more."""
    return text if len(text) <= most else f"{text[:most]}…"


def printable(text: str) -> str:
    """Return `text` in one line, with a sign for each character that a terminal would obey or not show."""
    return "".join(sign if sign.isprintable() else "\ufffd" for sign in text)


def in_lines(text: str) -> str:
    """Return a message of several lines, each printable, all but the first indented.

    No line of it can pass for a message of its own, whatever the names in it.
    """
    first, *others = text.split("\n")
    return "\n".join([printable(first), *(f"  {printable(line.removeprefix('  '))}" for line in others)])


def in_markdown(text: str) -> str:
    """Return a stranger's `text` in one line, as words in Markdown: no tag, heading, link or code."""
    shown = html.escape(printable(" ".join(text.split())), quote=False)
    return re.sub(r"([\\`*\[\]])", r"\\\1", shown)


def in_code(text: str) -> str:
    """Return a stranger's `text` in one line, as code in Markdown."""
    return f"`{printable(' '.join(text.split())).replace('`', chr(39))}`"
