"""The abstract simulator of a walking NAO: a planar body that follows commands at once; a resting ball."""

import torch
from torch import Tensor

from astra_data.dataset.columns import Column
from astra_data.worlds.geometry import turned
from astra_data.worlds.simulators import FreeStates

FORWARD_M_S = 0.25
BACKWARD_M_S = 0.15
LEFT_M_S = 0.20
TURN_RAD_S = 2.094
"""Maximum walking speeds of the robot's walk engine (BadgerRLSystemCodeRelease2023, walkingEngine.cfg: 250,
150 and 200 mm/s, 120 °/s)."""


def walk_command(action: Tensor) -> Tensor:
    """Return the body's commanded velocity (..., 3), forward and left in m/s, turn in rad/s.

    `action` (..., 4) is the policy's (turn, forward, left, kick), clipped to ±1; the kick is ignored. As in
    the robot's NeuralControl.cpp (BadgerRLSystemCodeRelease2023): fractions of the maximum speeds, with turn
    scaled by 0.6, a backward action by 0.5, and a forward action f > 0 mapped to 0.8 f + 0.2.
    """
    turn, forward, left = action[..., :3].clamp(-1.0, 1.0).unbind(-1)
    ahead = torch.where(forward > 0, (0.8 * forward + 0.2) * FORWARD_M_S, 0.5 * forward * BACKWARD_M_S)
    return torch.stack([ahead, left * LEFT_M_S, 0.6 * turn * TURN_RAD_S], dim=-1)


class PlanarWalker(FreeStates):
    """B bodies [x, y, heading, forward and left velocity, turn rate, ball x, ball y], in m, rad and s.

    Positions are in the field's frame, velocities in the body's. A command is the velocity of the next step,
    along an arc. Not modeled: legs, the delay of the walk, kicks, and the motion of the ball.

    Attributes:
        state: (B, 8) float32.
    """

    abstract_state = Column(
        "abstract.state",
        size=8,
        names=("x", "y", "heading", "v_forward", "v_left", "turn_rate", "ball_x", "ball_y"),
        meaning="pose and velocity of the body, and the ball",
        astra={
            "unit": ["m", "m", "rad", "m/s", "m/s", "rad/s", "m", "m"],
            "frame": ["field"] * 3 + ["body"] * 3 + ["field"] * 2,
            "role": ["position"] * 2 + ["heading"] + ["invariant"] * 3 + ["position"] * 2,
        },
    )

    def __init__(self, num_envs: int, *, timestep_s: float, device: str = "cpu") -> None:
        super().__init__(torch.zeros(num_envs, self.abstract_state.size, device=device))
        self.timestep_s = timestep_s

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters recorded in datasets that are paired with this simulator."""
        return {"timestep_s": self.timestep_s}

    def step(self, action: Tensor) -> Tensor:
        """Apply `action` (B, 4), see `walk_command`; return the new state (B, 8)."""
        velocity = walk_command(action)
        forward, left, turn = (velocity * self.timestep_s).unbind(-1)
        heading = self.state[:, 2]
        # The exact chord of an arc: (1 - cos t) / t = sin(t/2)² / (t/2), and sinc is defined at 0.
        along, across = torch.sinc(turn / torch.pi), torch.sinc(turn / 2 / torch.pi) * torch.sin(turn / 2)
        ahead, aside = along * forward - across * left, across * forward + along * left
        position = self.state[:, :2] + turned(torch.stack([ahead, aside], dim=-1), heading)
        pose = torch.cat([position, (heading + turn)[:, None]], dim=-1)
        self.state = torch.cat([pose, velocity, self.state[:, 6:]], dim=-1)
        return self.state
