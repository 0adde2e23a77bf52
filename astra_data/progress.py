"""How a long job tells how far it is."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with the fraction done, in [0, 1], and a short note: the rate and the figure that matters."""


def silent(fraction: float, note: str) -> None:
    """Tell nobody."""
