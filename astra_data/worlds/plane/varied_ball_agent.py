"""The planar point mass with a ball, with parameters that differ from row to row."""

import torch
from torch import Tensor

from astra_data.worlds.plane.ball import ROLLING_M_S2, asks_to_kick, kick_away, knock, roll
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.plane.states import VariedStates
from astra_data.worlds.variation import BallVariation, Variation, planar_command


class VariedBallAgent(VariedStates):
    """B point masses with balls like `BallAgent`'s, each with its own parameters (see `BallVariation`).

    What `state` shows is where everything is plus the noise of the sensors; noise is drawn from torch's
    global generator. With the plain parameters it is the plain simulator.
    """

    state_size = 8
    action_size = 3

    def __init__(
        self,
        maze: Maze,
        num_envs: int,
        variation: Variation,
        *,
        timestep_s: float,
        radius_m: float,
        speed_m_s: float,
        reach_m: float,
        knock_m_s: float,
        kick_reach_m: float,
        kick_m_s: float,
        device: str = "cpu",
    ) -> None:
        """Build B of them, as `BallAgent` does; ranges that `variation` does not have are plain."""
        ranges = BallVariation(**variation.model_dump())
        super().__init__(maze, num_envs, self.state_size, ranges, radius_m=radius_m, device=device)
        self.timestep_s, self.speed_m_s = timestep_s, speed_m_s
        self.reach_m, self.knock_m_s = reach_m, knock_m_s
        self.kick_reach_m, self.kick_m_s = kick_reach_m, kick_m_s

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, 3); return what is shown of the new state (B, 8)."""
        of = self.variation.by_name(self.parameters)
        period = self.timestep_s * of["timestep_scale"]
        position, _, ball, rolling = self.true_state.split(2, dim=-1)
        kicks, turn = asks_to_kick(action), torch.deg2rad(of["contact_direction_deg"])
        way = ~kicks * planar_command(of, action[:, :2]) * self.speed_m_s * period.unsqueeze(-1)
        moved, self.blocked = self.free.slide(position, position + way)
        ball, rolling = knock(
            position,
            moved,
            ball,
            rolling,
            reach_m=self.reach_m,
            speed_m_s=self.knock_m_s,
            turn_rad=turn,
        )
        rolling = kick_away(
            moved,
            ball,
            rolling,
            kicks,
            reach_m=self.kick_reach_m,
            speed_m_s=self.kick_m_s,
            turn_rad=turn,
        )
        ball, rolling = roll(ball, rolling, period, ROLLING_M_S2 * of["ball_friction"])
        velocity = (moved - position) / period.unsqueeze(-1)
        self.true_state = torch.cat([moved, velocity, ball, rolling], dim=-1)
        return self.show(
            [
                of["position_noise_m"],
                of["velocity_noise_m_s"],
                of["ball_position_noise_m"],
                of["ball_velocity_noise_m_s"],
            ]
        )
