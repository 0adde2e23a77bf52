"""Progress of long jobs."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with the fraction done, in [0, 1], and a short note, such as the rate and the loss."""


def silent(fraction: float, note: str) -> None:
    """Report nothing."""


def part(progress: Progress, begin: float, end: float) -> Progress:
    """Return the progress of a part of the job that covers the fractions `begin` to `end` of the whole."""
    return lambda fraction, note: progress(begin + (end - begin) * fraction, note)
