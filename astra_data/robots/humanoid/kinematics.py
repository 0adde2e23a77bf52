"""The humanoid's joints without its body: they follow commands, whatever happens to its balance.

Joints approach their targets, those that no command moves zero, as position control moves a massless joint;
the extended simulator adds the center of mass and the torso's lean. docs/results/humanoid.md: what both lack.
"""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn import functional

from astra_data.dataset.columns import ABSTRACT_STATE, Column
from astra_data.robots.humanoid.abstraction import (
    humanoid_to_extended_kinematics,
    humanoid_to_kinematics,
    mass_and_feet,
)
from astra_data.robots.humanoid.model import (
    COMMANDED,
    DAMPING,
    JOINTS,
    STANDING,
    STIFFNESS,
    TIMESTEP_S,
    CommandRanges,
    humanoid_model,
)
from astra_data.worlds.simulators import FreeStates

_COUNT = len(JOINTS)
_CENTER = slice(2 * _COUNT, 2 * _COUNT + 3)
_VELOCITY = slice(2 * _COUNT + 3, 2 * _COUNT + 6)
_UP = slice(2 * _COUNT + 6, 2 * _COUNT + 9)
_SPIN = slice(2 * _COUNT + 9, None)
_NAMES = (*JOINTS, *(f"{name}_rate" for name in JOINTS))
_UNITS = ["rad"] * _COUNT + ["rad/s"] * _COUNT


class HumanoidKinematics(FreeStates):
    """B humanoids' joints; action: angles of left hip and knee, right hip and knee, (B, 4), clipped to ±1.

    Attributes:
        state: (B, 34) float32, as `humanoid_to_kinematics` makes it.
    """

    action_size = 4
    abstract_state = Column(
        ABSTRACT_STATE,
        size=2 * _COUNT,
        names=_NAMES,
        meaning="angles and rates of all joints",
        astra={"unit": _UNITS, "frame": ["joint"] * 2 * _COUNT, "role": ["invariant"] * 2 * _COUNT},
    )
    abstraction = humanoid_to_kinematics

    ranges = CommandRanges()
    """Joint angles of commands."""

    def __init__(self, num_envs: int, *, device: str = "cpu") -> None:
        """Set B humanoids' joints to zero."""
        standing = type(self).abstraction(torch.tensor(STANDING))
        super().__init__(standing.repeat(num_envs, 1).to(device))
        self._damping = torch.from_numpy(humanoid_model().dof_damping[-_COUNT:]).float().to(device)
        self._approach = STIFFNESS / (DAMPING + self._damping)
        self._timestep_s = torch.tensor(TIMESTEP_S, device=device)

    @property
    def parameters(self) -> dict[str, float]:
        """What a dataset paired with this simulator records about it."""
        return {"timestep_s": TIMESTEP_S, **self.ranges.parameters}

    def vary(self, parameters: Mapping[str, Tensor]) -> None:
        """Use other joints and control steps from the next step on.

        Args:
            parameters: (B, 1) each: "friction", a factor on the joints' damping d; "timestep_scale", a factor
                on the control step.
        """
        self._approach = STIFFNESS / (DAMPING + parameters["friction"] * self._damping)
        self._timestep_s = TIMESTEP_S * parameters["timestep_scale"]

    def step(self, action: Tensor) -> Tensor:
        """Follow the commands `action` (B, 4) for one control step; return the new state (B, X)."""
        self.state = self._moved(action)
        return self.state

    def _moved(self, action: Tensor) -> Tensor:
        """Return angles and rates (B, 34) of all joints after the step."""
        angles = self.state[:, :_COUNT]
        target = torch.zeros_like(angles)
        target[:, COMMANDED] = self.ranges.targets(action)
        left = (target - angles) * torch.exp(-self._approach * self._timestep_s)
        return torch.cat([target - left, self._approach * left], dim=-1)


class HumanoidExtendedKinematics(HumanoidKinematics):
    """The same, with the center of mass and its velocity, and lean and angular velocity of the torso.

    Attributes:
        state: (B, 46) float32, as `humanoid_to_extended_kinematics` makes it.
    """

    abstract_state = Column(
        ABSTRACT_STATE,
        size=2 * _COUNT + 12,
        names=(
            *_NAMES,
            *("mass_x", "mass_y", "mass_z", "mass_vx", "mass_vy", "mass_vz"),
            *("up_x", "up_y", "up_z", "wx", "wy", "wz"),
        ),
        meaning="angles and rates of all joints; along the heading, centre of mass, from between the feet, "
        "and its velocity; which way is up from the torso, and how fast it turns",
        astra={
            "unit": [*_UNITS, *["m"] * 3, *["m/s"] * 3, *["1"] * 3, *["rad/s"] * 3],
            "frame": ["joint"] * 2 * _COUNT + ["heading"] * 6 + ["body"] * 6,
            "role": ["invariant"] * (2 * _COUNT + 12),
        },
    )
    abstraction = humanoid_to_extended_kinematics

    def __init__(self, num_envs: int, *, follow_s: float = 0.3, device: str = "cpu") -> None:
        """Build B standing humanoids.

        follow_s: time constant of the body's velocity and angular velocity, above 0.
        """
        super().__init__(num_envs, device=device)
        self.follow_s = follow_s

    @property
    def parameters(self) -> dict[str, float]:
        """What a dataset paired with this simulator records about it."""
        return {**super().parameters, "follow_s": self.follow_s}

    def _moved(self, action: Tensor) -> Tensor:
        """Return joints, center of mass and its velocity, lean and spin (B, 46) after the step."""
        joints = super()._moved(action)
        mass, feet = mass_and_feet(self.state[:, :_COUNT])
        later_mass, later_feet = mass_and_feet(joints[:, :_COUNT])
        aside = (later_mass - later_feet.mean(1)) - (mass - feet.mean(1))
        stance = feet[..., 2].argmin(dim=-1)
        rows = torch.arange(len(feet), device=feet.device)
        driven = ((later_mass - later_feet[rows, stance]) - (mass - feet[rows, stance])) / self._timestep_s
        share = -torch.expm1(-self._timestep_s / self.follow_s)
        velocity = torch.lerp(self.state[:, _VELOCITY], driven, share)
        shift = torch.cat([aside[:, :2], velocity[:, 2:] * self._timestep_s], dim=-1)
        spin = (1.0 - share) * self.state[:, _SPIN]
        up = self.state[:, _UP]
        up = functional.normalize(up - self._timestep_s * torch.linalg.cross(spin, up), dim=-1)
        return torch.cat([joints, self.state[:, _CENTER] + shift, velocity, up, spin], dim=-1)
