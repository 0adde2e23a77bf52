"""Trainings that diverge end with a line on the learning rate, not in an error of torch later on."""

import math
from collections.abc import Mapping

from astra_data.core.errors import BadInputError


def refuse_divergence(where: str, figures: Mapping[str, float | None]) -> None:
    """Check that the `figures` of a training, so far measured `where`, are numbers.

    Raises:
        BadInputError: one is infinite or not a number.
    """
    if wrong := [name for name, value in figures.items() if value is not None and not math.isfinite(value)]:
        figure = f"a {' and a '.join(wrong)} that is not finite"
        raise BadInputError(f"training diverged {where}, with {figure}: make learning_rate smaller")
