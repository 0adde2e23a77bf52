"""The humanoid's joints without its body: they follow commands, whatever these do to its balance.

Every joint of the humanoid is there. Commanded joints go toward their targets, all others toward zero, as
position control moves a joint that weighs nothing against its damping: the difference shrinks by a constant
share in each moment, K / (D + d), with the paper's gains K and D and the joint's damping d: 13 per second at
the hips, 18 at the knees. Within commands' ranges that asks no motor for more than it has. Against the
humanoid under random commands, each held for 7 steps, angles of commanded joints are 0.24 rad off after 10
steps; joints that reach their targets at once are 0.36 rad off, joints that do not move 0.30 rad.

The extended simulator adds the centre of mass and its velocity, and how the torso leans and turns. To the
centre of mass the torso is level, so that the joints alone say how it moves, seen from the
feet. Its velocity goes toward what it would be if the lower foot did not move, with a time constant of 0.3 s,
about that of a body of its height when it topples; the height follows the velocity. Without that delay,
joints that weigh nothing throw the body about: under those commands, its velocity along x is 3.3 m/s off
after a single step, and not 0.17 m/s. The torso turns on as it did, slowed with the same time constant.

Both leave out:

* Forces. No joint is ever slowed by what it carries, or pushed by what the foot stands on; none swings past
  its target. Rates are told, but how fast a joint was does not matter to where it goes.
* The world, without the extension: height, balance, walking and falling are nowhere in the state.

The extended one leaves out:

* Falling by itself: there is no weight. A centre of mass that has left the feet stays beside them, and sinks
  no faster than it did. The state can tell a fall, and so a correction of it can make one.
* What turns the torso, and what its turning does: the motion that legs give to the centre of mass is as of an
  upright one.
* Flight, slipping and double support: one foot always stands, the other never brakes. The floor is nowhere.
"""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn import functional

from astra_data.dataset.columns import ABSTRACT_STATE, Column
from astra_data.worlds.free_states import FreeStates
from astra_data.worlds.humanoid.abstraction import humanoid_to_extended_kinematics, humanoid_to_kinematics
from astra_data.worlds.humanoid.model import (
    COMMANDED,
    DAMPING,
    JOINTS,
    STANDING,
    STIFFNESS,
    TIMESTEP_S,
    CommandRanges,
    humanoid_model,
)
from astra_data.worlds.humanoid.skeleton import mass_and_feet

_COUNT = len(JOINTS)
_CENTRE = slice(2 * _COUNT, 2 * _COUNT + 3)
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
    abstraction = staticmethod(humanoid_to_kinematics)

    def __init__(self, num_envs: int, *, ranges: CommandRanges | None = None, device: str = "cpu") -> None:
        """Put B humanoids' joints at zero; `ranges` says what commands stand for."""
        self.ranges = ranges or CommandRanges()
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
        """Follow the commands `action` (B, 4) for 0.015 s, or as varied; return the new state (B, X)."""
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
    """The same, with the centre of mass and its velocity, and how the torso leans and turns.

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
    abstraction = staticmethod(humanoid_to_extended_kinematics)

    def __init__(
        self,
        num_envs: int,
        *,
        ranges: CommandRanges | None = None,
        follow_s: float = 0.3,
        device: str = "cpu",
    ) -> None:
        """Stand B humanoids up.

        Args:
            num_envs: B.
            ranges: what commands stand for.
            follow_s: time constant of the body's velocity and spin, above 0.
            device: torch device.
        """
        super().__init__(num_envs, ranges=ranges, device=device)
        self.follow_s = follow_s

    @property
    def parameters(self) -> dict[str, float]:
        """What a dataset paired with this simulator records about it."""
        return {**super().parameters, "follow_s": self.follow_s}

    def _moved(self, action: Tensor) -> Tensor:
        """Return joints, centre of mass and its velocity, lean and spin (B, 46) after the step."""
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
        return torch.cat([joints, self.state[:, _CENTRE] + shift, velocity, up, spin], dim=-1)
