"""A policy in a simulator, here in that of its training."""

from dataclasses import replace
from functools import partial
from statistics import fmean

import torch
from constant_policy import Constant
from small_cart import TASK, Last

from astra_data.grounding.simulator import NO_GROUNDING
from astra_data.policies.episodes import RecordedRange, in_simulator, started
from astra_data.policies.running_policy import PolicyFile, UserPolicy, running
from astra_data.policies.simulator_env import Simulation, WorldConfig, training_env

SIMULATION = Simulation(WorldConfig())
SPEED = 4.0
FORWARD = PolicyFile(UserPolicy(Constant(1.0), 2, 1), SIMULATION, None, None)


def test_the_goals_are_those_of_the_seed_in_any_simulator() -> None:
    acting = running(TASK, FORWARD, NO_GROUNDING)
    begin = partial(started, acting, acting.act_in_simulator)
    asked = RecordedRange(torch.tensor([0.0]), torch.tensor([2.0]), TASK.limits)
    runs = [
        in_simulator(training_env(TASK, simulation, NO_GROUNDING, num_envs=9), begin, 40, seed, None if seed else asked)
        for simulation in (SIMULATION, Simulation(WorldConfig(), TASK.varied.randomized))
        for seed in (0, 1)
    ]
    goals = [start_goal["goal"] for _, start_goal in runs]
    assert torch.equal(goals[0], goals[2]) and not torch.equal(goals[0], goals[1])
    outcome = runs[0][0]
    # It stops where the last episode ends; every command of 4 m/s is beyond 2 m/s.
    assert outcome.position.shape[1] - 1 == max(outcome.steps) <= 5 and asked.share == 1.0
    assert [steps for steps in outcome.steps] == [
        int(torch.ceil(goal / (0.1 * SPEED) - 1e-4)) for goal in goals[0][:, 0]
    ]
    assert fmean(outcome.success) == 1.0


def test_where_it_is_to_last_an_episode_succeeds_in_its_last_step() -> None:
    world = training_env(replace(TASK, objective=Last(horizon=6)), SIMULATION, NO_GROUNDING, num_envs=3)
    found, _ = in_simulator(world, lambda goal: lambda state, goal: torch.full_like(goal, -0.6), 6, seed=0)
    assert found.success == [1.0] * 3 and found.steps == [6] * 3
