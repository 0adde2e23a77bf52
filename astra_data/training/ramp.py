"""How the penalties of a training grow."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

Points = Sequence[Mapping[str, float | None]]

_RECENT = 5
"""Points of the learning curve over which success is averaged."""


@dataclass(frozen=True)
class Ramp:
    """The factor on penalties as a training goes on.

    Attributes:
        share: of the training, over which it grows from 0 to 1; 0: it is 1 from the start.
        while_success: success of training episodes below which it falls, as fast, in place of growing.
    """

    share: float = 0.0
    while_success: float = 0.0

    def scale(self, points: Points, steps: int, total_steps: int) -> float:
        """Return the factor after `steps` of `total_steps`.

        Args:
            points: the learning curve until then.
            steps: done.
            total_steps: of the training.
        """
        if not self.share:
            return 1.0
        if not self.while_success:
            return min(1.0, steps / (total_steps * self.share))
        scale, before = 0.0, 0.0
        for number, point in enumerate(points, 1):
            now = float(point["steps"] or 0.0)
            change = (now - before) / (total_steps * self.share)
            known = [one["success"] for one in points[max(0, number - _RECENT) : number]]
            recent = [success for success in known if success is not None]
            succeeds = bool(recent) and fmean(recent) >= self.while_success
            scale = min(1.0, max(0.0, scale + (change if succeeds else -change)))
            before = now
        return scale
