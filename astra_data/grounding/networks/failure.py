"""A failure model: the probability that the target fails soon, given the last second.

A robot that is about to fall lags behind its commands, and is close to a wall or on its way there. The latent
of the history says more where failures are many, and is memorized where they are few: whether the network
sees it is decided by likelihood on episodes that it was not fitted to.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from astra_data.core.numbers import normalized
from astra_data.grounding.networks.paired_windows import PairedWindows
from astra_data.grounding.networks.scales import add_scales, take_scales

AVERAGED_S = (0.25, 0.5, 1.0)
"""Time constants of the averages of the magnitudes, beside their present values."""
AHEAD_S = (0.25, 0.5, 1.0, 1.5, 2.0)
"""How far ahead walls are looked for, both as the robot moves and as the simulator does."""
FAILURE_STEPS = 2
"""Steps within which failures are predicted: of 2, 5, 10 and 20 the one with the highest likelihood of the
moments of failures on a cart, an ant and a NAO."""
_FARTHEST_M = 3.0
"""Walls farther away than this are alike."""
_MAGNITUDES = 5


@dataclass(frozen=True)
class FailureShape:
    """Sizes of the failure model.

    Attributes:
        state_size: X. action_size: A. timestep_s: of the task.
        maze_cells: (height, width) of the maze's fine grid; zeros where there is no maze.
        cell_m: side of its cells.
        members: networks, whose probabilities are averaged.
        risk_steps: within how many steps failures are predicted.
        latent_size: Z, of the latent among the inputs; 0 where it is none of them.
        hidden_size: of their two layers. dropout: rate after each.
    """

    state_size: int
    action_size: int
    timestep_s: float
    maze_cells: tuple[int, int] = (0, 0)
    cell_m: float = 1.0
    members: int = 5
    risk_steps: int = FAILURE_STEPS
    latent_size: int = 0
    hidden_size: int = 32
    dropout: float = 0.2

    @property
    def input_size(self) -> int:
        """I: magnitudes, their averages, distances from walls, and the latent."""
        return self.motion_size + self.latent_size

    @property
    def motion_size(self) -> int:
        """The inputs but for the latent."""
        walls = 1 + 2 * len(AHEAD_S) if any(self.maze_cells) else 0
        return _MAGNITUDES * (1 + len(AVERAGED_S)) + walls


class FailureModel(nn.Module):
    """Estimate the probability of a failure within the shape's `risk_steps`, from before a step is corrected.

    The memory (B, M) is an argument and a result, never kept: the last state, where the simulator had landed,
    the last action, and the averages.
    """

    def __init__(self, shape: FailureShape) -> None:
        super().__init__()
        self.shape = shape
        sizes, hidden = shape.input_size, shape.hidden_size
        self.members = nn.ModuleList(
            nn.Sequential(
                *(nn.Linear(sizes, hidden), nn.ELU(), nn.Dropout(shape.dropout)),
                *(nn.Linear(hidden, hidden), nn.ELU(), nn.Dropout(shape.dropout)),
                nn.Linear(hidden, 1),
            )
            for _ in range(shape.members)
        )
        for name in ("wanted", "moved", "missed"):
            self.register_buffer(f"{name}_std", torch.ones(shape.state_size))
        add_scales(self, {"input": sizes})
        self.register_buffer("log_odds_shift", torch.zeros(()))
        self.register_buffer("clearance", torch.zeros(shape.maze_cells))
        self.register_buffer("half_extent", torch.zeros(2))
        rates = [1 - torch.tensor(-shape.timestep_s / seconds).exp() for seconds in AVERAGED_S]
        self.register_buffer("rates", torch.stack(rates)[:, None], persistent=False)
        self.wanted_std: Tensor
        self.moved_std: Tensor
        self.missed_std: Tensor
        self.input_mean: Tensor
        self.input_std: Tensor
        self.log_odds_shift: Tensor
        self.clearance: Tensor
        self.half_extent: Tensor
        self.rates: Tensor

    def set_move_scales(self, windows: PairedWindows) -> None:
        """Take the deviations of moves from training episodes."""
        mask = windows.mask.bool()
        for name, moves in {
            "wanted": windows.simulated_next - windows.state,
            "moved": windows.next_state - windows.state,
            "missed": windows.next_state - windows.simulated_next,
        }.items():
            getattr(self, f"{name}_std").copy_(moves[mask].std(0).clamp_min(1e-3))

    def set_input_scales(self, inputs: Tensor) -> None:
        """Take the means and deviations of inputs (N, I)."""
        take_scales(self, {"input": inputs})

    def initial_memory(
        self, state: Tensor, previous_action: Tensor, averages: Tensor | None = None
    ) -> Tensor:
        """Return the memory (n, M) of episodes that start in `state` (n, X).

        `averages` (n, 15) are those of the history before; by default there is none.
        """
        if averages is None:
            averages = state.new_zeros(len(state), self.averages_size)
        return torch.cat([state, state, previous_action, averages], dim=-1)

    def averages_of(self, inputs: Tensor) -> Tensor:
        """Return the averages (..., 15) among what the networks saw of a step, (..., I)."""
        return inputs[..., _MAGNITUDES : _MAGNITUDES + self.averages_size]

    def step(
        self, state: Tensor, action: Tensor, landed: Tensor, latent: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the probability (B,) of a failure within `risk_steps`, and the next memory (B, M).

        Args:
            state: s_i, (B, X).
            action: a_i, (B, A).
            landed: where the simulator landed from there, not corrected, (B, X).
            latent: z_i, (B, Z).
            memory: before the step, (B, M).
        """
        inputs, memory = self.inputs(state, action, landed, latent, memory)
        return self.probability(inputs), memory

    def inputs(
        self, state: Tensor, action: Tensor, landed: Tensor, latent: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return what the networks see of a step, (B, I), and the next memory (B, M); see `step`."""
        before, landed_before, action_before, averages = memory.split(self._parts, dim=-1)
        magnitudes, walls = self._signals(state, action, landed, before, landed_before, action_before)
        averages = self._averaged(averages, magnitudes)
        return (
            torch.cat([magnitudes, averages, walls, latent[..., : self.shape.latent_size]], dim=-1),
            torch.cat([state, landed, action, averages], dim=-1),
        )

    def probability(self, inputs: Tensor) -> Tensor:
        """Return the mean (...) of the members' probabilities for `inputs` (..., I)."""
        return (self.log_odds(inputs) + self.log_odds_shift).sigmoid().mean(0)

    def log_odds(self, inputs: Tensor) -> Tensor:
        """Return the log-odds (K, ...) by each member for `inputs` (..., I).

        Failures are drawn more often than they come: `log_odds_shift` is not added yet.
        """
        normal = normalized(inputs, self.input_mean, self.input_std)
        return torch.stack([member(normal).squeeze(-1) for member in self.members])

    @torch.no_grad()
    def calibrate(self, scale: Tensor, shift: Tensor) -> None:
        """Scale the members' log-odds, and shift them by the rate of failures."""
        for member in self.members:
            for parameter in list(member.parameters())[-2:]:
                parameter.mul_(scale)
        self.log_odds_shift.copy_(shift)

    def hazard(self, probability: Tensor) -> Tensor:
        """Return the probability (...) of a failure in the very step, given that within `risk_steps`."""
        return probability / self.shape.risk_steps

    @property
    def memory_size(self) -> int:
        """M."""
        return sum(self._parts)

    @property
    def averages_size(self) -> int:
        """Of the averages of each magnitude over each time."""
        return len(AVERAGED_S) * _MAGNITUDES

    @property
    def _parts(self) -> list[int]:
        shape = self.shape
        return [shape.state_size, shape.state_size, shape.action_size, self.averages_size]

    def _averaged(self, averages: Tensor, magnitudes: Tensor) -> Tensor:
        """Move averages (B, 3 * 5) toward `magnitudes` (B, 5), each at its rate."""
        now = averages.unflatten(-1, (len(AVERAGED_S), _MAGNITUDES))
        moved: Tensor = now + self.rates * (magnitudes.unsqueeze(-2) - now)
        return moved.flatten(-2)

    def _signals(
        self,
        state: Tensor,
        action: Tensor,
        landed: Tensor,
        before: Tensor,
        landed_before: Tensor,
        action_before: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return magnitudes (..., 5) and distances from walls (..., 11), or (..., 0) without a maze.

        The magnitudes: how far the simulator would move, how far the target moved, how far that was from
        where the simulator had landed; the change of the action, and the action.
        """
        wanted, moved, missed = landed - state, state - before, state - landed_before
        magnitudes = [
            _root_mean_square(wanted / self.wanted_std),
            _root_mean_square(moved / self.moved_std),
            _root_mean_square(missed / self.missed_std),
            (action - action_before).norm(dim=-1),
            action.norm(dim=-1),
        ]
        if not self.clearance.numel():
            return torch.stack(magnitudes, dim=-1), state[..., :0]
        seconds = torch.tensor(AHEAD_S, device=state.device)[:, None]
        position = state[..., None, :2]
        ways = [move[..., None, :2] * seconds / self.shape.timestep_s for move in (wanted, moved)]
        places = torch.cat([position, *(position + way for way in ways)], dim=-2)
        return torch.stack(magnitudes, dim=-1), self._clearance_at(places)

    def _clearance_at(self, places: Tensor) -> Tensor:
        """Return the distance (...) in m from `places` (..., 2) to the nearest wall, as far as it matters."""
        column, row = ((places + self.half_extent) / self.shape.cell_m).floor().long().unbind(-1)
        height, width = self.clearance.shape
        nearest = self.clearance[row.clamp(0, height - 1), column.clamp(0, width - 1)]
        return nearest.clamp_max(_FARTHEST_M)


def _root_mean_square(values: Tensor) -> Tensor:
    return values.square().mean(-1).sqrt()
