"""Variation: how the parameters of planar simulators differ from episode to episode."""

from collections.abc import Mapping, Sequence
from typing import Annotated

import torch
from pydantic import AfterValidator
from torch import Tensor

from astra_data.geometry import turned
from astra_data.recipe import Config


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError(f"expected the lower end first, got {list(ends)}")
    return ends


def _above_zero(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] <= 0:
        raise ValueError(f"expected a range above 0, got {list(ends)}")
    return ends


def _not_below_zero(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] < 0:
        raise ValueError(f"expected a range from 0 up, got {list(ends)}")
    return ends


Range = Annotated[tuple[float, float], AfterValidator(_ordered)]
FactorRange = Annotated[Range, AfterValidator(_above_zero)]
NoiseRange = Annotated[Range, AfterValidator(_not_below_zero)]


class Variation(Config):
    """Ranges of the parameters of an episode, drawn uniformly; by default all are the plain simulator's.

    In this simulator friction, action scale and timestep all lengthen or shorten the way of a command, so
    positions tell their product only; velocities, that of the first two.
    """

    friction: FactorRange = (1.0, 1.0)
    """Factor on the speed that a command gives."""
    action_scale: Range = (0.0, 0.0)
    """Share by which commands are too long."""
    action_noise: NoiseRange = (0.0, 0.0)
    """Standard deviation of Gaussian noise on commands, in m/s."""
    position_noise_m: NoiseRange = (0.0, 0.0)
    """Half width of the uniform noise on shown positions."""
    velocity_noise_m_s: NoiseRange = (0.0, 0.0)
    """Half width of the uniform noise on shown velocities."""
    heading_bias_deg: Range = (0.0, 0.0)
    """Commands are turned by this angle."""
    timestep_scale: FactorRange = (1.0, 1.0)
    """Factor on the control period."""

    @staticmethod
    def of_json(ranges: Mapping[str, Sequence[float]]) -> "Variation":
        """Return what `model_dump` gave, after a way through JSON."""
        kind = BallVariation if "ball_friction" in ranges else Variation
        return kind(**{name: tuple(ends) for name, ends in ranges.items()})  # type: ignore[arg-type]

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters, in the order of their columns."""
        return tuple(type(self).model_fields)

    def noiseless(self) -> "Variation":
        """Return the same ranges without any noise."""
        names = (name for name in self.names if "noise" in name)
        return self.model_copy(update=dict.fromkeys(names, (0.0, 0.0)))

    def ranges(self) -> Tensor:
        """Return lower and upper end of every parameter, (P, 2), in the order of `names`."""
        return torch.tensor([getattr(self, name) for name in self.names])

    def by_name(self, parameters: Tensor) -> dict[str, Tensor]:
        """Return the columns (B,) of `parameters` (B, P) by their names."""
        return dict(zip(self.names, parameters.unbind(-1), strict=True))

    def draw(self, count: int, device: torch.device | str = "cpu") -> Tensor:
        """Draw the parameters (count, P) of as many episodes, from torch's global generator."""
        low, high = self.ranges().to(device).unbind(-1)
        return low + (high - low) * torch.rand(count, len(low), device=device)

    def normal(self, parameters: Tensor) -> Tensor:
        """Map parameters (..., P) to -1 at the lower and 1 at the upper end of their ranges, (..., P)."""
        low, high = self.ranges().to(parameters.device).unbind(-1)
        middle, half = (low + high) / 2, (high - low) / 2
        # A parameter that does not vary tells nothing: it is 0.
        return torch.where(half > 0, (parameters - middle) / half.clamp_min(1e-9), 0.0)


class BallVariation(Variation):
    """Ranges of the parameters of an episode with a ball."""

    ball_friction: FactorRange = (1.0, 1.0)
    """Factor on the deceleration of the rolling ball."""
    ball_position_noise_m: NoiseRange = (0.0, 0.0)
    """Half width of the uniform noise on shown positions of the ball."""
    ball_velocity_noise_m_s: NoiseRange = (0.0, 0.0)
    """Half width of the uniform noise on shown velocities of the ball."""
    contact_direction_deg: Range = (0.0, 0.0)
    """The ball leaves a contact turned by this angle."""


RANDOMIZED_ACTIONS = Variation(action_noise=(0.05, 0.05), action_scale=(-0.1, 0.1))
"""Of domain randomization in navigation, as printed (Section V-A)."""

WIDE_RANGES = Variation(
    friction=(0.8, 1.2),
    action_scale=(-0.1, 0.1),
    action_noise=(0.05, 0.05),
    position_noise_m=(0.03, 0.03),
    velocity_noise_m_s=(0.0, 0.02),
    heading_bias_deg=(-5.0, 5.0),
    timestep_scale=(0.75, 1.25),
)
"""Of COMPASS in navigation, as printed (Section V-A): a control period of 0.015 to 0.025 s is read as shares
of one of 0.02 s."""


def varied_command(of: Mapping[str, Tensor], action: Tensor) -> Tensor:
    """Return what becomes of commands (B, 2): noisy, cut, turned, scaled, by the parameters `of` (B,) each.

    Noise is drawn from torch's global generator.
    """
    noise = of["action_noise"].unsqueeze(-1) * torch.randn_like(action)
    command = (action + noise).clamp(-1.0, 1.0)
    steered = turned(command, torch.deg2rad(of["heading_bias_deg"]))
    return (of["friction"] * (1.0 + of["action_scale"])).unsqueeze(-1) * steered
