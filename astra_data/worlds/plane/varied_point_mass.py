"""The planar point mass with parameters that differ from row to row: for randomisation and identification."""

import torch
from torch import Tensor

from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.plane.states import VariedStates
from astra_data.worlds.variation import Variation, planar_command


class VariedPointMass(VariedStates):
    """B point masses like those of `PointMass`, each with its own parameters (see `PlanarVariation`).

    A command gets noise, is clipped to ±1 per axis, scaled and turned; the mass follows it for one
    control period of its own length. What `state` shows is where it is plus the noise of the sensors; noise
    is drawn from torch's global generator. With the plain parameters it is the plain point mass.
    """

    state_size = 4
    action_size = 2

    def __init__(
        self,
        maze: Maze,
        num_envs: int,
        variation: Variation,
        *,
        timestep_s: float,
        radius_m: float = 0.1,
        speed_m_s: float = 1.0,
        device: str = "cpu",
    ) -> None:
        super().__init__(maze, num_envs, self.state_size, variation, radius_m=radius_m, device=device)
        self.timestep_s = timestep_s
        self.speed_m_s = speed_m_s

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, 2); return what is shown of the new state (B, 4)."""
        of = self.variation.by_name(self.parameters)
        velocity = planar_command(of, action) * self.speed_m_s
        period = (self.timestep_s * of["timestep_scale"]).unsqueeze(-1)
        position = self.true_state[:, :2]
        moved, self.blocked = self.free.slide(position, position + velocity * period)
        self.true_state = torch.cat([moved, (moved - position) / period], dim=-1)
        return self.show([of["position_noise_m"], of["velocity_noise_m_s"]])
