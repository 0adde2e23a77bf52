"""How a long job tells how far it is."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with the fraction done, in [0, 1], and a short note: the rate and the figure that matters."""


def silent(fraction: float, note: str) -> None:
    """Tell nobody."""


def part(progress: Progress, begin: float, end: float) -> Progress:
    """Return the progress of a part of the job, which goes from `begin` to `end` of the whole."""
    return lambda fraction, note: progress(begin + (end - begin) * fraction, note)
