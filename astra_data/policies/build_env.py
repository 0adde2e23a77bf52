"""Build the environment that a policy is trained in: from a grounding, switches and the data."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from astra_data.core.config import Config, NotNegative, Positive, Share
from astra_data.grounding.failures import averages_before
from astra_data.grounding.history import HistoryGrounding
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.protocols import Grounding
from astra_data.policies.simulator_env import DataStarts, RewardSource, SimulatorEnv
from astra_data.worlds.objective import NO_LIMIT
from astra_data.worlds.task import Task
from astra_data.worlds.variation import Variation

_CHANGE_PENALTY = 0.02
"""Of the plus settings; recorded ants fall where commands change."""


class WorldConfig(Config):
    """The environment that a policy is trained in, as it is written beside the policy."""

    reward: RewardSource = "abstract"
    """Source of the reward; see `SimulatorEnv`."""
    change_penalty: NotNegative = 0.0
    """Subtracted from the reward of a step, multiplied by the squared change of the command."""
    command_limit: Positive = NO_LIMIT
    """Commands longer than this are shortened, in training and in the target; a multiple of the largest along
    an axis."""
    data_start_share: Share = 0.0
    """Fraction of the episodes that start from the middle of a recorded one."""

    @property
    def prices_failures(self) -> bool:
        """Whether it makes a difference how probably the target fails."""
        return self.reward != "abstract"

    @property
    def limits_commands(self) -> bool:
        """Whether commands are shortened."""
        return self.command_limit != NO_LIMIT


def plus(world: WorldConfig, command_limit: float) -> WorldConfig:
    """Return the plus settings of `world`: failures are priced, and changes of the command cost."""
    changes = {"reward": "priced", "change_penalty": _CHANGE_PENALTY, "command_limit": command_limit}
    return world.model_copy(update=changes)


@dataclass(frozen=True)
class Simulation:
    """The abstract simulator that a policy is trained in.

    Attributes:
        world: the environment's settings.
        variation: ranges of the simulator's parameters, drawn for each episode.
    """

    world: WorldConfig
    variation: Variation | None = None


@torch.no_grad()
def data_starts(
    task: Task, world: WorldConfig, episodes: PairedEpisodes, grounding: Grounding
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


def _used(grounding: Grounding, world: WorldConfig) -> Grounding:
    """Return what `world` makes use of in a grounding."""
    if world.prices_failures or not isinstance(grounding, HistoryGrounding):
        return grounding
    return replace(grounding, failures=None)


def _remembered(task: Task, grounding: Grounding, episodes: PairedEpisodes, every: int) -> Tensor | None:
    """Return what the grounding, and its failure model, remember before each `every`-th recorded step."""
    hidden = grounding.hidden_before(episodes.windows, every)
    if hidden is None or not isinstance(grounding, HistoryGrounding) or grounding.failures is None:
        return hidden
    averages = averages_before(task, grounding, grounding.failures, episodes)
    return torch.cat([hidden, averages[:, ::every]], dim=-1)


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
    """Build the environment: the task in the raw, varied or grounded simulator.

    Args:
        task: the task.
        simulation: the environment's settings, and what varies.
        grounding: that the simulator is corrected by.
        num_envs: episodes side by side.
        device: torch device.
        starts: recorded moments, see `data_starts`; without them, all episodes start where the task does.
        shows_parameters: end observations with the normalized parameters of a simulator that varies.
    """
    world = simulation.world
    used = _used(grounding, world)
    return SimulatorEnv(
        task.objective,
        used.simulator(task, num_envs, device, variation=simulation.variation),
        reward=world.reward,
        command_limit=world.command_limit,
        change_penalty=world.change_penalty,
        starts=starts,
        data_start_share=world.data_start_share if starts else 0.0,
        shows_parameters=shows_parameters,
    )
