"""Put together the world that a method's policy is trained in, from a method, its switches and the data."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from astra_data.dataset.pairs import PairedEpisodes
from astra_data.free_space import FreeSpace
from astra_data.mazes import FIELD_CELL_M
from astra_data.method import Method
from astra_data.models.grounding import GroundingModel
from astra_data.recipe import Config
from astra_data.sims.grounded import GroundedSimulator
from astra_data.sims.randomized import RandomizedSimulator
from astra_data.tasks import Task
from astra_data.world import DataStarts, NavigationWorld, RewardSource, Simulator

_SUPPORT_CELL = 2
"""Side of a cell of the support map, in cells of the maze's fine grid."""


class WorldConfig(Config):
    """Switches of the training world. All off is the method as it is published; each may be given to any.

    `topple` and the reward "blend" need a grounded simulator and are without effect in the raw one.
    """

    reward: RewardSource | None = None
    """Where the reward comes from: "abstract", "predicted" or "blend"; by default as the method says."""
    topple: bool = False
    """Draw topples from the topple head: they end the episode and cost what they cost in the target."""
    residual_noise: float = 0.0
    """Scatter the state after each step by so many times the scatter that the simulator does not explain."""
    support: bool = False
    """Close the cells that the data hardly visits."""
    support_points: int = 3
    """Fewer visits than this in a cell of 0.2 m are hardly any."""
    blocked_reward: float = 0.0
    """Added in each step that is stopped at a wall or a closed cell."""
    data_start_share: float = 0.0
    """Share of the episodes that start in the midst of a recorded one."""


@dataclass(frozen=True)
class WorldParts:
    """What a training world is made of beside its switches.

    Attributes:
        free: where positions may be.
        scatter: factor of the state noise, (X, X).
        starts: recorded moments, if episodes may start there.
    """

    free: FreeSpace
    scatter: Tensor
    starts: DataStarts | None = None


@torch.no_grad()
def world_parts(
    task: Task, config: WorldConfig, episodes: PairedEpisodes, model: GroundingModel | None
) -> WorldParts:
    """Derive closed cells, scatter and starts from paired episodes, as far as `config` asks for them."""
    windows = episodes.windows
    device = str(windows.state.device)
    free = task.simulator(1, device).free
    if config.support:
        visited = torch.cat([episodes.steps(windows.state), episodes.steps(windows.next_state)])[:, :2]
        free = free.within(_supported(free, visited, 2 * config.support_points))
    if model is not None:
        scatter = model.residual_factor
    else:
        residual = episodes.steps(windows.next_state - windows.simulated_next)
        scatter = torch.linalg.cholesky(torch.cov(residual.T) + 1e-9 * torch.eye(4, device=device))
    starts = None
    if config.data_start_share > 0:
        hidden = None
        if model is not None:
            inputs = model.encoder_input(windows.state, windows.goal, windows.previous_action)
            _, after = model.encoder(inputs)
            hidden = episodes.steps(functional.pad(after[:, :-1], (0, 0, 1, 0)))
        starts = DataStarts(
            state=episodes.steps(windows.state),
            goal=episodes.steps(windows.goal),
            previous_action=episodes.steps(windows.previous_action),
            hidden=hidden,
        )
    return WorldParts(free, config.residual_noise * scatter, starts)


def _supported(free: FreeSpace, positions: Tensor, least: int) -> Tensor:
    height, width = free.blocked.shape
    cells = ((positions + free.half_extent) / (FIELD_CELL_M * _SUPPORT_CELL)).long()
    columns = width // _SUPPORT_CELL
    counts = torch.bincount(
        cells[:, 1] * columns + cells[:, 0], minlength=(height // _SUPPORT_CELL) * columns
    )
    coarse = counts.reshape(-1, columns) >= least
    return coarse.repeat_interleave(_SUPPORT_CELL, 0).repeat_interleave(_SUPPORT_CELL, 1)


def training_world(
    task: Task,
    method: Method,
    config: WorldConfig,
    parts: WorldParts,
    model: GroundingModel | None,
    *,
    num_envs: int,
    device: str,
) -> NavigationWorld:
    """Build the world: the task in the raw, scattered or grounded simulator."""
    inner = task.simulator(num_envs, device)
    simulator: Simulator = inner
    if model is not None:
        simulator = GroundedSimulator(inner, model, parts.free, scatter=parts.scatter)
    elif config.residual_noise or config.support:
        simulator = RandomizedSimulator(inner, parts.free, parts.scatter)
    return NavigationWorld(
        task.navigation,
        simulator,
        reward=config.reward or method.reward,
        topple=config.topple,
        blocked_reward=config.blocked_reward,
        starts=parts.starts,
        data_start_share=config.data_start_share if parts.starts else 0.0,
    )
