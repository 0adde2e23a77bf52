"""Build the environment that a policy is trained in: from a grounding, switches and the data."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import scipy
import torch
from pydantic import Field, model_validator
from torch import Tensor

from astra_data.core.config import Config, Count, NotNegative, Positive, Share
from astra_data.grounding.failures import averages_before
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import Grounding
from astra_data.learning.recorded import Recorded
from astra_data.training.ramp import Ramp
from astra_data.training.simulator_env import DataStarts, RewardSource, SimulatorEnv, policy_observation
from astra_data.worlds.objective import NO_LIMIT
from astra_data.worlds.plane.free_space import FreeSpace
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation

_KERNEL_M = 0.25
"""Standard deviation of the kernel that smooths the density of the data."""


class EnvConfig(Config):
    """Switches of the environment that a policy is trained in; all off is the method as published.

    Any method accepts them, but the raw simulator has no model to predict from: there `topple` and
    `disagreement_penalty` have no effect, the reward "blend" is the abstract one, and "predicted" is
    refused. For policies trained in the target, only `data_start_share` has an effect; for those learned from
    recorded episodes alone, none has.
    """

    reward: RewardSource | None = None
    """Source of the reward: "abstract", "predicted" or "blend"; by default that of the method."""
    topple: bool = False
    """Sample topples from the topple head: they end the episode and cost as much as a failure. Then the
    reward "blend" is the abstract one: a risk that is drawn is not priced as well."""
    risk_weight: NotNegative = 1.0
    """How many topples a predicted one counts as in "blend", without `topple`: a topple also costs the rest
    of the episode."""
    residual_noise: NotNegative = 0.0
    """Noise added to the state after each step, in units of the target's scatter around the simulator."""
    support_penalty: NotNegative = 0.0
    """Subtracted from the reward of a step to a place without data; less is subtracted where data is thin."""
    support_density: Positive = 0.3
    """Data is thin where its density is below this fraction of the free space's median density."""
    disagreement_penalty: NotNegative = 0.0
    """Subtracted from the reward of a step, multiplied by how much the correction's heads (`[ground]
    correction_heads`) disagree beyond the usual; with `keep_member`, by how much a row's member disagrees
    with the model."""
    keep_member: bool = Field(default=False, exclude_if=lambda keeps: not keeps)
    """Use one of the `[ground] members` to correct each row and predict its reward, in equal shares:
    simulators that differ are harder to exploit."""
    change_penalty: NotNegative = Field(default=0.0, exclude_if=lambda weight: not weight)
    """Subtracted from the reward of a step, multiplied by the squared change of the command; not ramped up.
    Robots fall and lose time when commands jump."""
    command_limit: Positive = NO_LIMIT
    """Shorten commands longer than this, in training and in the target, as a multiple of the largest along an
    axis (1 m/s for the ant); by default no command is shortened."""
    ramp: Share = 0.0
    """Fraction of the training over which the penalties grow from zero: at full size from the start, they
    teach the robot to stand still."""
    ramp_while: Share = Field(default=0.0, exclude_if=lambda share: not share)
    """Success of training episodes at or above which the penalties grow; below it they shrink at the same
    speed, so that caution does not cost progress. 0: they always grow."""
    data_start_share: Share = 0.0
    """Fraction of the episodes that start from the middle of a recorded one."""
    episode_steps: Count | None = None
    """Steps after which simulated episodes are truncated and their values bootstrapped; by default the task's
    horizon. In short episodes from recorded states, errors have no time to grow (Janner et al. 2019)."""

    @model_validator(mode="after")
    def _has_a_ramp(self) -> Self:
        if self.ramp_while and not self.ramp:
            raise ValueError("ramp_while: expected a ramp, a share of the training over which penalties grow")
        return self

    @property
    def penalty_ramp(self) -> Ramp:
        """How the penalties grow."""
        return Ramp(self.ramp, self.ramp_while)

    @property
    def foresees(self) -> bool:
        """Whether it makes a difference how probably the target fails."""
        return self.topple or self.reward in ("predicted", "blend")

    @property
    def limits_commands(self) -> bool:
        """Whether commands are shortened."""
        return self.command_limit != NO_LIMIT


@dataclass(frozen=True)
class Simulation:
    """The abstract simulator that a policy is trained in.

    Attributes:
        thinness: 1 where there is no data, 0 where there is enough, on the maze's fine grid (height, width);
            None where there is no maze.
        scatter: factor of the noise added in training, (X, X); zeros where there is none.
        world: the switches of the environment.
        variation: ranges of the simulator's parameters, drawn for each episode.
    """

    thinness: Tensor | None
    scatter: Tensor
    world: EnvConfig
    variation: Variation | None = None


@torch.no_grad()
def simulation_of(
    task: Task,
    world: EnvConfig,
    episodes: PairedEpisodes,
    grounding: Grounding,
    variation: Variation | None = None,
) -> Simulation:
    """Derive thinness, and scatter if `world` asks for it, from paired episodes."""
    state = episodes.windows.state
    thinness = None
    if task.plane is not None:
        thinness = _thinness(task.maze, episodes.steps(state)[:, :2], world.support_density)
    scatter = state.new_zeros(state.shape[-1], state.shape[-1])
    if world.residual_noise:
        scatter = world.residual_noise * grounding.scatter(episodes)
    return Simulation(thinness, scatter, world, variation)


@torch.no_grad()
def data_starts(
    task: Task, world: EnvConfig, episodes: PairedEpisodes, grounding: Grounding
) -> DataStarts | None:
    """Return the recorded moments that episodes may start from; None unless `world` asks for them."""
    if not world.data_start_share:
        return None
    windows, every = episodes.windows, grounding.start_stride
    moments = windows.mask[:, ::every].bool()
    hidden = _remembered(task, _used(grounding, world), episodes, every)
    return DataStarts(
        state=windows.state[:, ::every][moments],
        goal=windows.goal[:, ::every][moments],
        previous_action=windows.previous_action[:, ::every][moments],
        hidden=None if hidden is None else hidden[moments],
    )


@torch.no_grad()
def recorded_steps(task: Task, episodes: PairedEpisodes, grounding: Grounding) -> Recorded:
    """Return the recorded episodes as seen by a policy that is trained with `grounding`."""
    windows, encoder, latent = episodes.windows, grounding.encoder, None
    if encoder is not None:
        inputs = encoder.encoder_input(windows.state, windows.goal, windows.previous_action)
        latent, _ = encoder.encoder(inputs)
    return Recorded(
        observation=policy_observation(task.objective, windows.state, windows.goal, latent),
        previous_action=windows.previous_action,
        action=windows.action,
        lengths=episodes.lengths,
    )


def _used(grounding: Grounding, config: EnvConfig) -> Grounding:
    """Return what `config` makes use of in a grounding."""
    return grounding.reduced(members=config.keep_member, failures=config.foresees)


def _remembered(task: Task, grounding: Grounding, episodes: PairedEpisodes, every: int) -> Tensor | None:
    """Return what the grounding, and its failure model, remember before each `every`-th recorded step."""
    hidden = grounding.hidden_before(episodes.windows, every)
    if hidden is None or not isinstance(grounding, HistoryGrounding) or grounding.failures is None:
        return hidden
    averages = averages_before(task, grounding, grounding.failures, episodes)
    return torch.cat([hidden, averages[:, ::every]], dim=-1)


def _thinness(maze: Maze, positions: Tensor, density: float) -> Tensor:
    free = FreeSpace.of_maze(maze, radius_m=0.0, device=str(positions.device))
    height, width = free.blocked.shape
    rows, columns = free.cells(positions)
    counts = torch.bincount(rows * width + columns, minlength=height * width).reshape(height, width)
    smooth = scipy.ndimage.gaussian_filter(counts.double().cpu().numpy(), _KERNEL_M / maze.fine_m)
    # Where most of the maze was never visited, the median is zero, and any visit at all is enough.
    enough = max(density * float(np.median(smooth[~maze.fine_walls])), 1e-9)
    return torch.from_numpy(1.0 - smooth / enough).clamp_min(0.0).float().to(positions.device)


def training_env(
    task: Task,
    simulation: Simulation,
    grounding: Grounding,
    *,
    num_envs: int,
    device: str,
    starts: DataStarts | None = None,
    shows_parameters: bool = False,
) -> SimulatorEnv:
    """Build the environment: the task in the raw, varied, scattered or grounded simulator.

    Args:
        task: the task.
        simulation: what is derived from data, and the switches.
        grounding: that the simulator is corrected by.
        num_envs: episodes side by side.
        device: torch device.
        starts: recorded moments, see `data_starts`; without them, all episodes start where the task does.
        shows_parameters: end observations with the normalized parameters of a simulator that varies.

    Raises:
        BadInputError: the switches ask for what needs a maze, and the task has none.
    """
    config = simulation.world
    if task.plane is None and (config.support_penalty or config.limits_commands):
        raise task.without_maze()
    scatter = simulation.scatter if config.residual_noise else None
    thinness = None
    if config.support_penalty and simulation.thinness is not None:
        thinness = config.support_penalty * simulation.thinness
    used = _used(grounding, config)
    simulator = used.simulator(task, num_envs, device, variation=simulation.variation, scatter=scatter)
    return SimulatorEnv(
        task.objective,
        simulator,
        reward=config.reward or "abstract",
        topple=config.topple,
        risk_weight=config.risk_weight,
        command_limit=config.command_limit,
        thinness=thinness,
        disagreement_penalty=config.disagreement_penalty,
        change_penalty=config.change_penalty,
        starts=starts,
        data_start_share=config.data_start_share if starts else 0.0,
        shows_parameters=shows_parameters,
    )
