"""Values of logs as they are written into the files of a new robot."""

import json
from collections.abc import Iterable, Sequence

import numpy as np

from astra_data.core.arrays import Floats


def typical(episodes: Sequence[Floats], failed: Sequence[bool]) -> tuple[Floats, float]:
    """Return the end (D,) of the episode whose way from its start is the median, and a tenth of the way.

    Episodes that failed have no say in that, unless all did. Where the episode ends as it began, it is a
    tenth of the farthest way that any went, or else of how far they lie apart.
    """
    kept = [values for values, fails in zip(episodes, failed, strict=True) if not fails] or episodes
    ways = [float(np.linalg.norm(values[-1] - values[0])) for values in kept]
    typical = int(np.argsort(ways)[len(ways) // 2])
    farthest = max(float(np.linalg.norm(values - values[0], axis=1).max()) for values in episodes)
    apart = float(np.linalg.norm(np.ptp(np.concatenate(episodes), axis=0)))
    return kept[typical][-1], (ways[typical] or farthest or apart) / 10


def numbers(values: Iterable[float] | Floats, brackets: str = "[]") -> str:
    """Return a list, or a tuple, as code."""
    inside = [repr(significant(value)) for value in values]
    comma = "," if brackets == "()" and len(inside) == 1 else ""
    return f"{brackets[0]}{', '.join(inside)}{comma}{brackets[1]}"


def significant(value: float) -> float:
    """Return a number of the logs as it is written down: to nine digits, as exact as float32."""
    return float(f"{value:.9g}") + 0.0


def texts(values: Iterable[str]) -> str:
    """Return a tuple as code."""
    inside = [json.dumps(value, ensure_ascii=False) for value in values]
    return f"({', '.join(inside)}{',' if len(inside) == 1 else ''})"
