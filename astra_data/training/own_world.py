"""Run a policy in a simulator; in particular a trained one in its own, by the mean of its actions."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from statistics import fmean

import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive
from astra_data.grounding.protocols import Grounding
from astra_data.training.build_env import EnvParts, training_env
from astra_data.training.episode_record import EpisodeRecord, Outcome
from astra_data.training.policy_file import PolicyFile, Simulation, running
from astra_data.training.recorded_range import RecordedRange
from astra_data.training.running_policy import RunningPolicy
from astra_data.training.simulator_env import SimulatorEnv
from astra_data.worlds.task import Task

Act = Callable[[Tensor, Tensor], Tensor]
Begin = Callable[[Tensor], Act]
"""Given the goals (N, G) of new episodes, returns the function that acts in them."""

_EPISODES = 100


def started(policy: RunningPolicy, act: Act, goal: Tensor) -> Act:
    """Start a policy in as many episodes as there are goals (N, G), and return its `act`."""
    policy.start(len(goal))
    return act


def own_world(task: Task, simulation: Simulation, grounding: Grounding, num_envs: int) -> SimulatorEnv:
    """Build the simulator that a policy was trained in; episodes start where the task does."""
    parts = EnvParts(simulation.thinness, simulation.scatter, variation=simulation.variation)
    return training_env(task, simulation.world, parts, grounding, num_envs=num_envs, device="cpu")


@torch.no_grad()
def in_simulator(
    world: SimulatorEnv, begin: Begin, horizon: int, seed: int, asked: RecordedRange | None = None
) -> tuple[Outcome, dict[str, Tensor]]:
    """Run an episode in each row of `world`; `asked` counts commands beyond what was recorded.

    Returns:
        the outcome, and the starts and goals, which are the same in every simulator.
    """
    torch.manual_seed(seed)
    world.reset()
    act = begin(world.goal)
    record = EpisodeRecord(world.objective.places(world.simulator.state))
    start_goal = {"start": world.objective.places(world.simulator.state).clone(), "goal": world.goal.clone()}
    for number in range(horizon):
        action = act(world.simulator.state, world.goal)
        if asked is not None:
            asked.count(action, record.active)
        step = world.step(action)
        success = world.objective.succeeded(step.success, world.failed, number + 1)
        blocked = world.simulator.blocked
        places = world.objective.places(world.simulator.state)
        record.add(places, step.reward, success, world.failed, blocked)
        if not record.active.any():
            break
    return record.outcome(), start_goal


@dataclass(frozen=True)
class Reached:
    """What a policy reaches in its own simulator.

    Attributes:
        success: share of the episodes. steps: mean of those that succeed; the horizon without any.
    """

    success: float
    steps: float


def reached_in_own_world(task: Task, trained: PolicyFile, grounding: Grounding, seed: int) -> Reached:
    """Test a policy in the simulator of its training, from the task's starts, by the mean of its actions.

    Raises:
        BadInputError: it does not know that simulator.
    """
    if trained.simulation is None:
        raise BadInputError(
            "tries: expected a policy that knows its simulator, got one without: give PolicyFile its "
            "simulation, or set tries = 1"
        )
    policy = running(task, trained, grounding)
    world = own_world(task, trained.simulation, grounding, _EPISODES)
    begin = partial(started, policy, policy.act_in_simulator)
    horizon = task.objective.horizon
    outcome, _ = in_simulator(world, begin, horizon, derive(seed, "trial in its own simulator"))
    steps = [steps for steps, success in zip(outcome.steps, outcome.success, strict=True) if success]
    return Reached(fmean(outcome.success), fmean(steps) if steps else float(horizon))
