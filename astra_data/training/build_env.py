"""Put together the world that a method's policy is trained in, from a method, its switches and the data."""

from dataclasses import dataclass

import numpy as np
import scipy
import torch
from torch import Tensor

from astra_data.core.config import Config, Count, NotNegative, Positive, Share
from astra_data.grounding.build import hidden_before, simulator_of
from astra_data.grounding.fit import scatter_factor
from astra_data.grounding.grounding_file import Grounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.learning.networks.grounding import GroundingModel
from astra_data.learning.networks.residual import ResidualModel
from astra_data.learning.recorded import Recorded
from astra_data.training.simulator_env import DataStarts, RewardSource, SimulatorWorld, policy_observation
from astra_data.worlds.plane.free_space import FreeSpace
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation

_KERNEL_M = 0.25
"""Standard deviation of the kernel that smooths the density of the data."""

_MEMORY_EVERY = 10
"""Of recorded steps, episodes start only from so many-th where the memory of an LSTM has to be kept for each:
of 100 k steps it would take 300 MB."""


class WorldConfig(Config):
    """Switches of the training world; all off is the method as it is published.

    Each may be given to any method, but the raw simulator has no model to predict from: there `topple` and
    `doubt_penalty` are without effect, the reward "blend" is the abstract one, and "predicted" is refused. Of
    policies that are trained in the target, `data_start_share` alone reaches any.
    """

    reward: RewardSource | None = None
    """Where the reward comes from: "abstract", "predicted" or "blend"; by default as the method says."""
    topple: bool = False
    """Draw topples from the topple head: they end the episode, and with the task's own reward they cost."""
    risk_weight: NotNegative = 1.0
    """How many topples a predicted one counts for in "blend": it costs the rest of the episode as well."""
    residual_noise: NotNegative = 0.0
    """Scatter the state after each step by so many times the scatter that the simulator does not explain."""
    support_penalty: NotNegative = 0.0
    """Taken from the reward of a step to where there is no data; less where there is some."""
    support_density: Positive = 0.3
    """Data is thin where its density is below this share of the median density of the free space."""
    doubt_penalty: NotNegative = 0.0
    """Taken from the reward of a step for each time by which the heads of the correction disagree more than
    usual; `[ground] correction_heads` has to be 2 or more."""
    command_limit_m_s: Positive = 2.0
    """Shorten longer commands to this, in training and in the target; by default longer than any command."""
    ramp: Share = 0.0
    """Share of the training over which the penalties grow from nothing: at once, they teach to stand."""
    data_start_share: Share = 0.0
    """Share of the episodes that start in the midst of a recorded one."""
    episode_steps: Count | None = None
    """Start simulated episodes anew after so many steps, beyond which values go on; by default after as many
    as in the task. Short ones from recorded moments leave errors no time to grow (Janner et al. 2019)."""

    @property
    def limits_commands(self) -> bool:
        """Whether commands are shortened."""
        return bool(self.command_limit_m_s != type(self).model_fields["command_limit_m_s"].default)


@dataclass(frozen=True)
class WorldParts:
    """What a training world is made of beside its switches.

    Attributes:
        thinness: 1 where there is no data, 0 where there is enough, on the maze's fine grid (height, width);
            None where there is no maze.
        scatter: factor of the state noise, (X, X).
        starts: recorded moments, if episodes may start there.
        variation: of the simulator's parameters from episode to episode.
    """

    thinness: Tensor | None
    scatter: Tensor
    starts: DataStarts | None = None
    variation: Variation | None = None


@torch.no_grad()
def world_parts(
    task: Task,
    config: WorldConfig,
    episodes: PairedEpisodes,
    grounding: Grounding | None,
    variation: Variation | None = None,
) -> WorldParts:
    """Derive thinness, scatter and starts from paired episodes, as far as `config` asks for them."""
    windows = episodes.windows
    thinness = None
    if task.plane is not None:
        thinness = _thinness(task.maze, episodes.steps(windows.state)[:, :2], config.support_density)
    if isinstance(grounding, GroundingModel | ResidualModel):
        scatter = grounding.residual_factor
    else:
        residual = episodes.steps(windows.next_state - windows.simulated_next)
        scatter = scatter_factor(residual)
    starts = None
    if config.data_start_share > 0:
        every = _MEMORY_EVERY if isinstance(grounding, ResidualModel) else 1
        moments = windows.mask[:, ::every].bool()
        hidden = hidden_before(grounding, windows, every)
        starts = DataStarts(
            state=windows.state[:, ::every][moments],
            goal=windows.goal[:, ::every][moments],
            previous_action=windows.previous_action[:, ::every][moments],
            hidden=None if hidden is None else hidden[moments],
        )
    return WorldParts(thinness, config.residual_noise * scatter, starts, variation)


@torch.no_grad()
def recorded_steps(task: Task, episodes: PairedEpisodes, grounding: Grounding | None) -> Recorded:
    """Return what was recorded as a policy sees it that is trained with `grounding`."""
    windows, latent = episodes.windows, None
    if isinstance(grounding, GroundingModel):
        latent, _ = grounding.encode(windows)
    return Recorded(
        observation=policy_observation(task.objective, windows.state, windows.goal, latent),
        previous_action=windows.previous_action,
        action=windows.action,
        lengths=episodes.lengths,
    )


def _thinness(maze: Maze, positions: Tensor, density: float) -> Tensor:
    free = FreeSpace.of_maze(maze, radius_m=0.0, device=str(positions.device))
    height, width = free.blocked.shape
    rows, columns = free.cells(positions)
    counts = torch.bincount(rows * width + columns, minlength=height * width).reshape(height, width)
    smooth = scipy.ndimage.gaussian_filter(counts.double().cpu().numpy(), _KERNEL_M / maze.fine_m)
    # Where most of the maze was never visited, the median is nothing, and any visit at all is enough.
    enough = max(density * float(np.median(smooth[~maze.fine_walls])), 1e-9)
    return torch.from_numpy(1.0 - smooth / enough).clamp_min(0.0).float().to(positions.device)


def training_world(
    task: Task,
    config: WorldConfig,
    parts: WorldParts,
    grounding: Grounding | None,
    *,
    num_envs: int,
    device: str,
    tells_parameters: bool = False,
) -> SimulatorWorld:
    """Build the world: the task in the raw, varied, scattered or grounded simulator.

    With `tells_parameters`, observations end with the normalised parameters of a simulator that varies.

    Raises:
        BadInputError: `config` asks for what needs a maze, and the task has none.
    """
    if task.plane is None and (config.support_penalty or config.limits_commands):
        raise task.without_maze()
    scatter = parts.scatter if config.residual_noise else None
    simulator = simulator_of(task, grounding, num_envs, device, variation=parts.variation, scatter=scatter)
    return SimulatorWorld(
        task.objective,
        simulator,
        reward=config.reward or "abstract",
        topple=config.topple,
        risk_weight=config.risk_weight,
        command_limit_m_s=config.command_limit_m_s,
        thinness=None if parts.thinness is None else config.support_penalty * parts.thinness,
        doubt_penalty=config.doubt_penalty,
        starts=parts.starts,
        data_start_share=config.data_start_share if parts.starts else 0.0,
        tells_parameters=tells_parameters,
    )
