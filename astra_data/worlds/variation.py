"""Variation: how the parameters of simulators differ from episode to episode."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated

from pydantic import AfterValidator

from astra_data.core.config import Config, NotNegative, Positive, in_order
from astra_data.core.lazy import Tensor, torch
from astra_data.worlds.protocols import TaskSimulator

Range = Annotated[tuple[float, float], AfterValidator(in_order)]
FactorRange = Annotated[tuple[Positive, Positive], AfterValidator(in_order)]
NoiseRange = Annotated[tuple[NotNegative, NotNegative], AfterValidator(in_order)]


class Variation(Config):
    """Ranges of the P parameters of an episode, drawn uniformly; by default all are the plain simulator's."""

    @staticmethod
    def of_json(ranges: Mapping[str, Sequence[float]]) -> "Variation":
        """Return the variation whose `model_dump` was written to JSON."""
        kinds = (BallVariation, JointVariation, CommandVariation)
        kind = next((kind for kind in kinds if kind.model_fields.keys() == ranges.keys()), PlanarVariation)
        return kind(**{name: tuple(ends) for name, ends in ranges.items()})  # type: ignore[arg-type]

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters, in the order of their columns."""
        return tuple(type(self).model_fields)

    def ranges(self) -> Tensor:
        """Return lower and upper end of every parameter, (P, 2), in the order of `names`."""
        return torch.tensor([getattr(self, name) for name in self.names])

    def draw(self, count: int, device: "torch.device | str" = "cpu") -> Tensor:
        """Draw the parameters (count, P) of as many episodes, from torch's global generator."""
        low, high = self.ranges().to(device).unbind(-1)
        return low + (high - low) * torch.rand(count, len(low), device=device)

    def normal(self, parameters: Tensor) -> Tensor:
        """Map parameters (..., P) to -1 at the lower and 1 at the upper end of their ranges, (..., P)."""
        low, high = self.ranges().to(parameters.device).unbind(-1)
        middle, half = (low + high) / 2, (high - low) / 2
        # A parameter that does not vary is 0.
        return torch.where(half > 0, (parameters - middle) / half.clamp_min(1e-9), 0.0)


class PlanarVariation(Variation):
    """Ranges for a robot in a plane; positions identify only the product of friction, action scale and timestep."""

    friction: FactorRange = (1.0, 1.0)  # factor on the speed that a command gives
    action_scale: Range = (0.0, 0.0)  # relative error of commands: 0.1 makes them 10 % longer
    action_noise: NoiseRange = (0.0, 0.0)  # standard deviation of Gaussian noise on commands of ±1 per axis
    position_noise_m: NoiseRange = (0.0, 0.0)  # half width of the uniform noise on observed positions
    velocity_noise_m_s: NoiseRange = (0.0, 0.0)  # half width of the uniform noise on observed velocities
    heading_bias_deg: Range = (0.0, 0.0)  # commands are turned by this angle
    timestep_scale: FactorRange = (1.0, 1.0)  # factor on the control period


class BallVariation(PlanarVariation):
    """Ranges for a robot in a plane, with a ball."""

    ball_friction: FactorRange = (1.0, 1.0)  # factor on the deceleration of the rolling ball
    ball_position_noise_m: NoiseRange = (0.0, 0.0)  # half width of the uniform noise on observed positions of the ball
    ball_velocity_noise_m_s: NoiseRange = (0.0, 0.0)  # half width of the uniform noise on its observed velocities
    contact_direction_deg: Range = (0.0, 0.0)  # the ball leaves a contact or a kick turned by this angle


class CommandVariation(Variation):
    """Ranges for any robot: of what reaches it of the commands."""

    action_scale: Range = (0.0, 0.0)  # relative error of commands: 0.1 makes them 10 % longer, up to their bounds
    action_noise: NoiseRange = (0.0, 0.0)  # standard deviation of Gaussian noise on commands, which range over ±1


class JointVariation(Variation):
    """Ranges for joints under position control; angles identify little but the quotient of friction and timestep."""

    friction: FactorRange = (1.0, 1.0)  # factor on the joints' own damping; that of the position control stays
    action_scale: Range = (0.0, 0.0)  # relative error of commands: 0.1 makes them 10 % longer
    action_noise: NoiseRange = (0.0, 0.0)  # standard deviation of Gaussian noise on commands, which range over ±1
    observation_scale: FactorRange = (1.0, 1.0)  # factor on all entries of the observed state
    timestep_scale: FactorRange = (1.0, 1.0)  # factor on the control period


class VariedSimulator(ABC):
    """B simulators with parameters that differ from row to row, observed through sensors."""

    def __init__(self, simulator: TaskSimulator, variation: Variation) -> None:
        self.simulator, self.variation = simulator, variation
        self.parameters = variation.draw(len(simulator.state), simulator.state.device)

    @property
    def state(self) -> Tensor:
        """The observed states, (B, X) float32; unless a subclass has sensors, the true ones of `simulator`."""
        return self.simulator.state

    @property
    def blocked(self) -> Tensor:
        """Which states (B,) were stopped at the edge of the free space in the last step, bool."""
        return self.simulator.blocked

    def by_name(self) -> dict[str, Tensor]:
        """Return the parameters by name, (B, 1) each."""
        return dict(zip(self.variation.names, self.parameters.split(1, dim=-1), strict=True))

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the true states in `rows` (n,), by default all, to `state` (n, X)."""
        self.simulator.reset_to(state, rows)

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Move from `before` to where `landed` is observed, both (B, X); return the observed states."""
        return self.simulator.settle(before, landed)

    @abstractmethod
    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, A); return the observed states (B, X)."""


RANDOMIZED_COMMANDS = CommandVariation(action_noise=(0.05, 0.05), action_scale=(-0.1, 0.1))
"""Of domain randomization of any robot, by default: the numbers that the paper prints for navigation."""

RANDOMIZED_ACTIONS = PlanarVariation(action_noise=(0.05, 0.05), action_scale=(-0.1, 0.1))
"""Of domain randomization in navigation, as printed in the paper (Section V-A)."""

WIDE_RANGES = PlanarVariation(
    friction=(0.8, 1.2),
    action_scale=(-0.1, 0.1),
    action_noise=(0.05, 0.05),
    position_noise_m=(0.03, 0.03),
    velocity_noise_m_s=(0.0, 0.02),
    heading_bias_deg=(-5.0, 5.0),
    timestep_scale=(0.75, 1.25),
)
"""Of COMPASS in navigation, as printed in the paper (Section V-A): a control period of 0.015 to 0.025 s is
read as factors on one of 0.02 s."""


def noisy_command(action: Tensor, deviation: Tensor) -> Tensor:
    """Return commands (B, A) with Gaussian noise of standard deviation `deviation` (B, 1), clipped to ±1."""
    return (action + deviation * torch.randn_like(action)).clamp(-1.0, 1.0)
