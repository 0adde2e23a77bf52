"""Names of result rows (methods, or `<method>_plus`: with the plus settings) and of what a run's folder holds."""

import html
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeGuard

PLUS = "_plus"
RECORD = "recipe.json"  # in the folder of a run: the settings that its artifacts were made with
CODE = "code.json"  # beside it: the digests of the user's code, "task" and methods by their names, and their settings
RUNS = Path("runs")  # the folder of the folders of runs, unless another is given
STAGE_NAMES = (
    *("collect", "label", "augment", "pair", "subset", "ground"),
    *("train", "align", "select", "evaluate", "report"),
)  # the stages in the order of the pipeline, for what need not load them


def is_plus(row: str) -> bool:
    """Return whether a row is trained with the plus settings."""
    return row.endswith(PLUS)


def base_method(row: str) -> str:
    """Return the name of a row's method: `astra` of "astra" and of "astra_plus"."""
    return row.removesuffix(PLUS)


def reference_of(rows: Iterable[str]) -> str | None:
    """Return the method in whose grounded simulator all `rows` are tested: NAS, if it is among them; else None."""
    return "nas" if "nas" in map(base_method, rows) else None


def artifact_key(stage: str, row: str, seed: int, percent: int | None = None) -> str:
    """Return the key of an artifact, its place in the folder of a run; `row` is empty for a dataset."""
    size = "" if percent is None else f"percent_{percent:03d}"
    return "/".join(filter(None, (stage, row, size, f"seed_{seed}")))


def stage_of_key(key: str) -> str:
    """Return the stage of an artifact's key, as "train" of "train/astra/seed_0"."""
    return key.partition("/")[0]


def row_of_key(key: str) -> str:
    """Return the row of the key of an artifact that has one, as "astra" of "train/astra/seed_0"."""
    return key.partition("/")[2].partition("/")[0]


def first_few(words: Sequence[object], most: int) -> str:
    """Name the first `most` of `words` and count the others: `a, b and 3 more`."""
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return ", ".join(map(str, words[:most])) + more


def shortened(text: str, most: int) -> str:
    """Return the first `most` characters of `text`, with an ellipsis where there are more."""
    return text if len(text) <= most else f"{text[:most]}…"


def is_text(value: object) -> TypeGuard[str]:
    """Return whether `value` is a text that can be written as UTF-8; names of files that are not UTF-8 cannot."""
    return isinstance(value, str) and not re.search("[\ud800-\udfff]", value)


def printable(text: str) -> str:
    """Return `text` in one line, with a sign for each character that a terminal would obey or not show."""
    return "".join(sign if sign.isprintable() else "\ufffd" for sign in text)


def in_lines(text: str) -> str:
    """Return a message of several lines, each printable; the indented ones cannot pass for messages of their own."""
    first, *others = text.split("\n")
    return "\n".join([printable(first), *(f"  {printable(line.removeprefix('  '))}" for line in others)])


def in_markdown(text: str) -> str:
    """Return a stranger's `text` in one line, as words in Markdown: no tag, heading, link or code."""
    shown = html.escape(printable(" ".join(text.split())), quote=False)
    return re.sub(r"([\\`*\[\]])", r"\\\1", shown)


def in_code(text: str) -> str:
    """Return a stranger's `text` in one line, as code in Markdown."""
    return f"`{printable(' '.join(text.split())).replace('`', chr(39))}`"
