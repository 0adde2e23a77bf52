"""Numbers and tables of the pages."""

from collections.abc import Iterable, Sequence

import numpy as np

from astra_data.reports.statistics import Summary


def table(head: Sequence[str], lines: Iterable[Iterable[str]], *, words: int = 1) -> str:
    """Return a Markdown table whose first `words` columns are aligned left, the others right."""
    rule = ["---"] * words + ["---:"] * (len(head) - words)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, rule, *lines))


def spread(summary: Summary | None, digits: int) -> str:
    """Return mean ± standard deviation; a dash for None."""
    if summary is None:
        return "-"
    deviation = "" if summary.std is None else f" ± {summary.std:.{digits}f}"
    return f"{summary.mean:.{digits}f}{deviation}"


def listed(words: Sequence[str]) -> str:
    """Return words as a list within a sentence."""
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def interval(value: float, low: float | None, high: float | None, digits: int = 2) -> str:
    """Return a value and, if it has one, its interval."""
    ends = "" if low is None or high is None else f" [{low:.{digits}f}, {high:.{digits}f}]"
    return f"{value:.{digits}f}{ends}"


def measured(value: float, low: float, high: float) -> str:
    """Return a measured value with three significant digits and, if it has one, its interval."""
    return f"{value:.3g}" if np.isnan([low, high]).any() else f"{value:.3g} [{low:.3g}, {high:.3g}]"


def short(rate: float) -> str:
    """Return a rate with three significant digits, in thousands from 1000 on, then in millions."""
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if rate >= 0.9995 * size:
            return f"{rate / size:.3g} {unit}"
    return f"{rate:.3g}"


def duration(seconds: float | None) -> str:
    """Return a time in seconds, minutes or hours; a dash for None."""
    if seconds is None:
        return "-"
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
