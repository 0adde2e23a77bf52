"""Individual differences between robots."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Floats
from astra_data.robots.nao.kinematics import JOINTS


@dataclass(frozen=True)
class TraitSpread:
    """Ranges that a robot's traits are drawn from; ours where no source is named."""

    joint_offset_deg: float = 0.35
    """Standard deviation of each joint's zero, which makes a robot veer; with 0.7 some turn the wrong way."""
    stiffness_loss: float = 0.3
    """Largest share of the servos' stiffness that is missing."""
    delay_ticks: tuple[int, int] = (2, 3)
    """Range of the delay from command to servo."""
    friction: tuple[float, float] = (0.4, 0.8)
    """Range of the floor's friction."""
    gyro_noise_rad_s: float = 0.05
    """Standard deviation per tick and axis: the same for all robots."""
    quality: tuple[float, float] = (0.83, 1.0)
    """Range of the factor on the top speeds: B-Human's limits of a worn and of a new robot."""


IDENTICAL = TraitSpread(0.0, 0.0, (2, 2), (0.6, 0.6), 0.0, (1.0, 1.0))
"""All robots alike, without noise."""


@dataclass(frozen=True)
class Traits:
    """The traits of B robots.

    Attributes:
        joint_offset_rad: true minus measured joint angles, (B, 11).
        stiffness: share of the servos' stiffness, (B,).
        delay_ticks: from command to servo, (B,) int.
        friction: of the floor, (B,).
        quality: factor on the top speeds, (B,).
    """

    joint_offset_rad: Floats
    stiffness: Floats
    delay_ticks: NDArray[np.intp]
    friction: Floats
    quality: Floats

    @classmethod
    def draw(cls, spread: TraitSpread, count: int, rng: np.random.Generator) -> "Traits":
        """Draw the traits of `count` robots."""
        return cls(
            joint_offset_rad=np.radians(rng.normal(0.0, spread.joint_offset_deg, (count, len(JOINTS)))),
            stiffness=1.0 - rng.uniform(0.0, spread.stiffness_loss, count),
            delay_ticks=rng.integers(*spread.delay_ticks, count, endpoint=True, dtype=np.intp),
            friction=rng.uniform(*spread.friction, count),
            quality=rng.uniform(*spread.quality, count),
        )
