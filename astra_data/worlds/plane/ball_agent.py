"""The abstract simulator of kicking: a planar point mass that kicks a rolling ball, or walks into it."""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import normalize

from astra_data.worlds.plane.ball import ROLLING_M_S2, asks_to_kick, kick_away, knock, roll
from astra_data.worlds.plane.geometry import turned
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.plane.states import PlanarStates

_LIES_M_S = 0.15
"""A ball that is not faster lies: it would roll on for at most 4 cm, and a robot's estimate of its speed is
never quite zero."""
_LEAVES_M_S = 0.5
"""Least speed with which corrections set a ball rolling that lay; the NAO's did about that in its kicks."""
_NOTHING_M_S = 0.05
"""Corrections to less than this set no ball rolling: scatter alone is as fast."""
_TURN_RAD = 0.4
"""Deviation of the ways in which hit balls leave from the simulator's, as in recorded kicks of the NAO."""
_FADES = 0.75
"""Share of the evidence of a hit that counts in the next step: a foot meets the ball within four steps."""


class BallAgent(PlanarStates):
    """B point masses, each with a ball: [x, y, vx, vy, ball x, ball y, ball vx, ball vy], in m and m/s.

    A command is the velocity of the next step, in units of the top speed along each axis, and whether to
    stand and kick. Walls stop the mass, not the ball. A kicked ball within reach leaves at one speed along
    the line between the centers, one that the mass walks into at another. Left out: the legs, the positions
    and timing of the feet, and the robot's heading.

    Corrections move only balls that rolled or were touched in the step, and say how fast they are, not where
    they go: recorded balls keep to the way that they rolled, and leave along the line between the centers,
    scattered, more than they keep to what is expected of them. Those that rolled go on, or lie again if that
    is slow. Whether one that lay starts to roll is drawn, such that the speed expected after the step is the
    corrected one: an expected correction mixes balls that are hit with others that are missed into one that
    creeps, or never moves. It is drawn once for as long as the ball lies: what makes a kick miss stays while
    nothing moves, and policies that kick from too far would else wait until it works.

    Attributes:
        memory: of each ball, the evidence of a hit that it takes to roll, in [0, 1), and what there was of
            late, (B, 2).
    """

    state_size = 8
    action_size = 3

    def __init__(
        self,
        maze: Maze,
        num_envs: int,
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
        """Build B of them.

        Args:
            maze: the walls.
            num_envs: B.
            timestep_s: control period.
            radius_m: distance that the mass keeps from walls, a multiple of the maze's `fine_m`.
            speed_m_s: top speed along each axis.
            reach_m: distance between the centers below which the mass touches the ball.
            knock_m_s: speed of a ball that the mass walks into.
            kick_reach_m: distance between the centers below which the mass can kick the ball.
            kick_m_s: speed of a kicked ball.
            device: torch device.
        """
        super().__init__(
            maze, num_envs, timestep_s=timestep_s, radius_m=radius_m, speed_m_s=speed_m_s, device=device
        )
        self.parameters |= {
            "reach_m": reach_m,
            "knock_m_s": knock_m_s,
            "kick_reach_m": kick_reach_m,
            "kick_m_s": kick_m_s,
        }
        self._rolls = torch.zeros(num_envs, 1, dtype=torch.bool, device=device)
        self.memory = self._undecided(num_envs)
        self._deceleration_m_s2: Tensor | float = ROLLING_M_S2
        self._contact_turn_rad: Tensor | float = 0.0

    def reset_to(self, state: Tensor, rows: Tensor | None = None) -> None:
        """Set the rows in `rows` (n,), by default all, to `state` (n, X); given `rows` are drawn for anew."""
        super().reset_to(state, rows)
        if rows is not None:
            self.memory = self.memory.index_copy(0, rows, self._undecided(len(rows)))

    def _undecided(self, count: int) -> Tensor:
        """Return the memory (n, 2) of so many balls of which there is no evidence."""
        device = self.state.device
        return torch.cat([torch.rand(count, 1, device=device), torch.zeros(count, 1, device=device)], dim=-1)

    def vary(self, parameters: Mapping[str, Tensor]) -> None:
        """Use the parameters of a `BallVariation` by name, (B, 1) each, from the next step on."""
        super().vary(parameters)
        self._deceleration_m_s2 = ROLLING_M_S2 * parameters["ball_friction"]
        self._contact_turn_rad = torch.deg2rad(parameters["contact_direction_deg"][:, 0])

    def step(self, action: Tensor) -> Tensor:
        """Apply commands `action` (B, 3), clipped to ±1 per axis; return the new state (B, 8)."""
        of, turn, kicks = self.parameters, self._contact_turn_rad, asks_to_kick(action)
        position, _, ball, velocity = self.state.split(2, dim=-1)
        way = ~kicks * self.commanded_velocity(action[:, :2]) * self.period_s
        moved, self.blocked = self.free.slide(position, position + way)
        ball, velocity = knock(
            position, moved, ball, velocity, reach_m=of["reach_m"], speed_m_s=of["knock_m_s"], turn_rad=turn
        )
        velocity = kick_away(
            moved, ball, velocity, kicks, reach_m=of["kick_reach_m"], speed_m_s=of["kick_m_s"], turn_rad=turn
        )
        self._rolls = velocity.norm(dim=-1, keepdim=True) > _LIES_M_S
        ball, velocity = roll(ball, velocity, self.period_s, self._deceleration_m_s2)
        self.state = torch.cat([moved, (moved - position) / self.period_s, ball, velocity], dim=-1)
        return self.state

    def settle(self, before: Tensor, landed: Tensor) -> Tensor:
        """Slide masses to `landed` (B, 8); move the balls, or draw whether they move: see the class."""
        own = self.state[:, 6:]
        moved = super().settle(before, landed)
        ball, velocity = before[:, 4:6], before[:, 6:]
        speed = moved[:, 6:].norm(dim=-1, keepdim=True)
        lay = velocity.norm(dim=-1, keepdim=True) <= _LIES_M_S
        turn_rad = _TURN_RAD * torch.randn(self.num_envs, device=ball.device)
        direction = normalize(torch.where(lay, turned(own, turn_rad), velocity))
        slowed_m_s = self._deceleration_m_s2 * self.period_s
        leaving = (speed + slowed_m_s).clamp_min(_LEAVES_M_S * lay)
        rolled = torch.cat(roll(ball, direction * leaving, self.period_s, self._deceleration_m_s2), dim=-1)
        touched = self._rolls & lay & (speed > _NOTHING_M_S)
        needed, evidence = self.memory.split(1, dim=-1)
        evidence = _FADES * evidence + touched * speed / (leaving - slowed_m_s).clamp_min(_NOTHING_M_S)
        rolls = torch.where(lay, touched & (evidence > needed), self._rolls & (speed > _LIES_M_S))
        undecided = self._undecided(self.num_envs)
        self.memory = torch.where(rolls, undecided, torch.cat([needed, evidence], dim=-1))
        still = torch.cat([ball, torch.zeros_like(ball)], dim=-1)
        self.reset_to(torch.cat([moved[:, :4], torch.where(rolls, rolled, still)], dim=-1))
        return self.state
