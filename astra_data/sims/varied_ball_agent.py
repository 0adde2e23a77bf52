"""The planar point mass with a ball, with parameters that differ from row to row."""

import torch
from torch import Tensor

from astra_data.ball import ROLLING_M_S2, knock, roll
from astra_data.free_space import FreeSpace
from astra_data.mazes import Maze
from astra_data.variation import BallVariation, Variation, varied_command


class VariedBallAgent:
    """B point masses with balls like `BallAgent`'s, each with its own parameters (see `BallVariation`).

    What `state` shows is where everything is plus the noise of the sensors; noise is drawn from torch's
    global generator. With the plain parameters it is the plain simulator.

    Attributes:
        variation: the ranges. parameters: (B, P), in the order of the variation's `names`.
        state: what is shown, (B, 8) float32. true_state: where everything is, likewise.
        free: where the mass may be. blocked: (B,) bool, a wall stopped the mass in the last step.
    """

    state_size = 8
    action_size = 2

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
        device: str = "cpu",
    ) -> None:
        """Build B of them, as `BallAgent` does; ranges that `variation` does not have are plain."""
        self.free = FreeSpace.of_maze(maze, radius_m=radius_m, device=device)
        self.variation = BallVariation(**variation.model_dump())
        self.num_envs = num_envs
        self.timestep_s, self.speed_m_s = timestep_s, speed_m_s
        self.reach_m, self.knock_m_s = reach_m, knock_m_s
        self.state = torch.zeros(num_envs, self.state_size, device=device)
        self.true_state = self.state
        self.blocked = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.parameters = self.variation.draw(num_envs, device)

    def redraw(self, rows: Tensor) -> None:
        """Draw new parameters for the rows `rows` (n,)."""
        drawn = self.variation.draw(len(rows), self.parameters.device)
        self.parameters = self.parameters.index_copy(0, rows, drawn)

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, 8)."""
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)
        self.true_state = state.clone() if rows is None else self.true_state.index_copy(0, rows, state)
        if rows is not None:
            self.blocked = self.blocked.index_fill(0, rows, False)

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, 2); return what is shown of the new state (B, 8)."""
        of = self.variation.by_name(self.parameters)
        period = self.timestep_s * of["timestep_scale"]
        position, _, ball, rolling = self.true_state.split(2, dim=-1)
        way = varied_command(of, action) * self.speed_m_s * period.unsqueeze(-1)
        moved, self.blocked = self.free.slide(position, position + way)
        ball, rolling = knock(
            position,
            moved,
            ball,
            rolling,
            reach_m=self.reach_m,
            speed_m_s=self.knock_m_s,
            turn_rad=torch.deg2rad(of["contact_direction_deg"]),
        )
        ball, rolling = roll(ball, rolling, period, ROLLING_M_S2 * of["ball_friction"])
        velocity = (moved - position) / period.unsqueeze(-1)
        self.true_state = torch.cat([moved, velocity, ball, rolling], dim=-1)
        widths = torch.stack(
            [
                of["position_noise_m"],
                of["velocity_noise_m_s"],
                of["ball_position_noise_m"],
                of["ball_velocity_noise_m_s"],
            ],
            dim=-1,
        )
        shown = torch.rand_like(self.true_state) * 2.0 - 1.0
        self.state = self.true_state + shown * widths.repeat_interleave(2, dim=-1)
        return self.state

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Slide the masses from `before` towards `landed`, both (B, 8); all else is that of `landed`."""
        position, self.blocked = self.free.slide(before[:, :2], landed[:, :2])
        self.reset_to(torch.cat([position, landed[:, 2:]], dim=-1))
        return self.state
