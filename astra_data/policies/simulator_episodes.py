"""Run a policy in a simulator, an episode in each of its rows."""

from collections.abc import Callable

import torch
from torch import Tensor

from astra_data.policies.episode_record import EpisodeRecord, Outcome
from astra_data.policies.recorded_range import RecordedRange
from astra_data.policies.running_policy import RunningPolicy
from astra_data.policies.simulator_env import SimulatorEnv

Act = Callable[[Tensor, Tensor], Tensor]
Begin = Callable[[Tensor], Act]
"""Given the goals (N, G) of new episodes, returns the function that acts in them."""


def started(policy: RunningPolicy, act: Act, goal: Tensor) -> Act:
    """Start a policy in as many episodes as there are goals (N, G), and return its `act`."""
    policy.start(len(goal))
    return act


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
