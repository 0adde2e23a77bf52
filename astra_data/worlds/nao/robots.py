"""What B NAOs share, with physics or without: what can be known of them, and going on from a state."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from astra_data.worlds.nao.steps import Bools, Floats, Gait


@dataclass(frozen=True)
class Senses:
    """What B robots feel at the end of a control step.

    Attributes:
        angles: measured joint angles, (B, 11) in rad (`worlds.nao.kinematics.JOINTS`).
        gyro: measured rates about x, y, z, (B, 3) in rad/s.
        tilt: roll and pitch of the torso, (B, 2) in rad.
        pressure: on the soles in N; left and right foot, front left, front right, back left, back right
            point, (B, 2, 4).
        phase: fraction of the step done, (B,).
        left_swings: which foot is in the air, (B,) bool.
        planned: velocity of the present step, m/s, m/s, rad/s, (B, 3).
    """

    angles: Floats
    gyro: Floats
    tilt: Floats
    pressure: Floats
    phase: Floats
    left_swings: Bools
    planned: Floats


class Robots(ABC):
    """B robots that walk.

    Attributes:
        gait: where the robots are in their steps.
    """

    gait: Gait
    _steps: int

    @property
    @abstractmethod
    def fallen(self) -> Bools:
        """Which robots lie on the floor, (B,)."""

    @property
    @abstractmethod
    def touching(self) -> Bools:
        """Which robots touched a wall in their last control step, (B,)."""

    @property
    @abstractmethod
    def pose(self) -> Floats:
        """True x, y of the torsos in m and their heading in rad, (B, 3)."""

    @property
    @abstractmethod
    def velocity(self) -> Floats:
        """True velocity of the torsos on the floor, x, y in m/s, turn in rad/s, (B, 3)."""

    @property
    @abstractmethod
    def ball(self) -> Floats:
        """The balls' true x, y in m, (B, 2)."""

    @property
    @abstractmethod
    def ball_velocity(self) -> Floats:
        """The balls' true velocity in m/s, (B, 2)."""

    @property
    @abstractmethod
    def senses(self) -> Senses:
        """What the robots feel now."""

    @abstractmethod
    def _arrays(self) -> dict[str, NDArray[Any]]:
        """Return all that changes from step to step, by name, to be written to."""

    def state_dict(self) -> dict[str, Any]:
        """Return copies of all that `load_state_dict` needs to go on exactly from here."""
        return {name: value.copy() for name, value in self._arrays().items()} | {"steps": self._steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state`, taken from robots that were built alike."""
        for name, value in self._arrays().items():
            value[:] = state[name]
        self._steps = int(state["steps"])
