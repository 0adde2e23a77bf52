"""Tables and plain text in Markdown."""

import re
from collections.abc import Iterable, Mapping, Sequence

from astra_data.reports import blocks as formatting

_CODE = re.compile(r"(`[^`]*`)")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; line breaks within cells become spaces."""
    return formatting.table(head, (map(_cell, row) for row in rows), words=len(head)) + "\n"


def _cell(text: str) -> str:
    return _beside_code(" ".join(text.split()), {"|": "\\|"})


def plain(text: str) -> str:
    """Return text in which only code between backticks is marked up: no tags, no emphasis."""
    return _beside_code(text, {"<": "&lt;", "*": "\\*"})


def _beside_code(text: str, written: Mapping[str, str]) -> str:
    """Return text with some characters written otherwise, but not in code."""
    parts = _CODE.split(text)
    others = {ord(character): other for character, other in written.items()}
    parts[::2] = [part.translate(others) for part in parts[::2]]
    return "".join(parts)
