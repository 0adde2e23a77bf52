"""Measures by which methods are compared on a task."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Score:
    """A measure of episodes; the larger, the better.

    Attributes:
        measure: its name in evaluation.json, which has one number per episode.
        title: of a table's column.
        quantity: name of its mean over episodes, within a sentence.
        digits: shown behind the decimal point.
        limit: the largest possible value, at which axes end; None where there is none.
    """

    measure: str
    title: str
    quantity: str
    digits: int
    limit: float | None = None

    def text(self, value: float) -> str:
        """Return a value with its digits."""
        return f"{value:.{self.digits}f}"


SUCCESS = Score("success", "success", "success rate", 2, limit=1.0)

SURVIVED_STEPS = Score("steps", "survived steps", "number of survived steps", 0)

RETURN = Score("return", "return", "return", 1)
