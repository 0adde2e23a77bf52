"""Run a trained policy in the simulator of its training, by the mean of its actions."""

from dataclasses import dataclass
from functools import partial
from statistics import fmean

from astra_data.core.errors import BadInputError
from astra_data.core.seeding import derive
from astra_data.grounding.protocols import Grounding
from astra_data.policies.build_env import Simulation, training_env
from astra_data.policies.policy_file import PolicyFile, running
from astra_data.policies.simulator_env import SimulatorEnv
from astra_data.policies.simulator_episodes import in_simulator, started
from astra_data.worlds.task import Task

_EPISODES = 100


def own_world(task: Task, simulation: Simulation, grounding: Grounding, num_envs: int) -> SimulatorEnv:
    """Build the simulator that a policy was trained in; episodes start where the task does."""
    return training_env(task, simulation, grounding, num_envs=num_envs, device="cpu")


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
