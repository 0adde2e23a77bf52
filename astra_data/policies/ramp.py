"""How a training follows the success of its episodes: penalties grow, and a mastered one ends early."""

from collections.abc import Mapping, Sequence
from statistics import fmean

Points = Sequence[Mapping[str, float | None]]

_RECENT = 5
"""Points of the learning curve over which success is averaged."""
MASTERED = 0.95
"""Success of training episodes from which on a simulator counts as mastered."""
FAST = 3.0
"""Pace of a training that has mastered its simulator, of one that has not."""
_GROWTH_SHARE = 0.4
"""Share of the training over which penalties grow from 0 to full size."""


def is_mastered(points: Points) -> bool:
    """Return whether the last training episodes succeed as often as `MASTERED`."""
    recent = [success for point in points[-_RECENT:] if (success := point.get("success")) is not None]
    return bool(recent) and fmean(recent) >= MASTERED


def penalty_scale(points: Points) -> float:
    """Return the factor on penalties, from 0 to 1, after the `points` of a learning curve.

    It grows while the simulator is mastered and falls as fast while not, so that caution does not cost
    success; at full size from the start, penalties teach the robot to stand still.
    """
    scale, before = 0.0, 0.0
    for number, point in enumerate(points, 1):
        now = float(point["share"] or 0.0)
        change = (now - before) / _GROWTH_SHARE
        scale += change if is_mastered(points[max(0, number - _RECENT) : number]) else -change
        scale, before = min(1.0, max(0.0, scale)), now
    return scale
