"""A policy in the simulator that it was trained in."""

from dataclasses import replace
from functools import partial
from statistics import fmean

import pytest
import torch
from constant_policy import Constant
from small_cart import TASK, Last

from astra_data.core.errors import BadInputError
from astra_data.grounding.raw import NO_GROUNDING
from astra_data.training.build_env import EnvConfig
from astra_data.training.own_policy import OwnPolicy
from astra_data.training.own_world import in_simulator, own_world, reached_in_own_world, started
from astra_data.training.policy_file import PolicyFile, Simulation, running
from astra_data.training.recorded_range import RecordedRange

SIMULATION = Simulation(None, torch.zeros(1, 1), EnvConfig())
SPEED = 4.0


def constant(command: float, simulation: Simulation = SIMULATION) -> PolicyFile:
    return PolicyFile(OwnPolicy(Constant(command), 2, 1), simulation, None, None)


def test_what_it_reaches_is_what_the_simulator_s_rule_says() -> None:
    """Forward at 0.4 m a step, goals from 1 to 2 m, uniform: 3, 4 or 5 steps; 4.2 on average."""
    reached = reached_in_own_world(TASK, constant(1.0), NO_GROUNDING, seed=0)
    assert reached.success == 1.0 and reached.steps == pytest.approx(4.2, abs=0.2)
    # At 0.4 m/s goals up to 1.6 m are in reach in 4 s.
    some = reached_in_own_world(TASK, constant(-0.44), NO_GROUNDING, seed=0)
    assert some.success == pytest.approx(0.6, abs=0.15)
    assert some.steps == pytest.approx(32.5, abs=1.5)  # of those that arrive, in 25 to 40
    none = reached_in_own_world(TASK, constant(-1.0), NO_GROUNDING, seed=0)
    assert (none.success, none.steps) == (0.0, 40.0)
    assert reached_in_own_world(TASK, constant(-0.44), NO_GROUNDING, seed=1) != some


def test_a_policy_that_knows_no_simulator_cannot_be_tried() -> None:
    trained = PolicyFile(OwnPolicy(Constant(1.0), 2, 1), None, None, None)
    with pytest.raises(BadInputError, match=r"tries: expected a policy that knows its simulator"):
        reached_in_own_world(TASK, trained, NO_GROUNDING, seed=0)


def test_it_has_the_noise_that_it_was_trained_with() -> None:
    quiet, noisy = (
        own_world(
            TASK, Simulation(None, factor * torch.eye(1), EnvConfig(residual_noise=1.0)), NO_GROUNDING, 50
        )
        for factor in (0.0, 0.5)
    )
    for world, scatter in ((quiet, 0.0), (noisy, 0.5)):
        world.reset()
        world.step(torch.zeros(50, 1))
        assert float(world.simulator.state.std()) == pytest.approx(scatter, abs=0.15)


def test_the_goals_are_those_of_the_seed_in_any_simulator() -> None:
    acting = running(TASK, constant(1.0), NO_GROUNDING)
    begin = partial(started, acting, acting.act_in_simulator)
    asked = RecordedRange(torch.tensor([0.0]), torch.tensor([2.0]), TASK.limits)
    runs = [
        in_simulator(
            own_world(TASK, simulation, NO_GROUNDING, 9), begin, 40, seed, asked if not seed else None
        )
        for simulation in (SIMULATION, Simulation(None, 0.1 * torch.eye(1), EnvConfig(residual_noise=1.0)))
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
    world = own_world(replace(TASK, objective=Last(horizon=6)), SIMULATION, NO_GROUNDING, 3)
    found, _ = in_simulator(world, lambda goal: lambda state, goal: torch.full_like(goal, -0.6), 6, seed=0)
    assert found.success == [1.0] * 3 and found.steps == [6] * 3


def test_it_starts_where_the_task_does() -> None:
    simulation = Simulation(None, torch.zeros(1, 1), EnvConfig(data_start_share=1.0))
    world = own_world(TASK, simulation, NO_GROUNDING, 5)
    world.reset()
    assert world.starts is None and not world.simulator.state.any()


def test_what_was_told_of_episodes_stays_when_others_follow_in_the_same_simulator() -> None:
    world, acting = own_world(TASK, SIMULATION, NO_GROUNDING, 3), running(TASK, constant(1.0), NO_GROUNDING)
    begin = partial(started, acting, acting.act_in_simulator)
    (_, first), (_, second), (_, again) = (in_simulator(world, begin, 40, seed) for seed in (0, 1, 0))
    assert torch.equal(first["goal"], again["goal"]) and not torch.equal(first["goal"], second["goal"])


def test_its_parameters_vary_as_they_did_when_it_was_trained() -> None:
    varied = replace(SIMULATION, variation=TASK.varied.randomized)
    shown = [own_world(TASK, known, NO_GROUNDING, 5).simulator.parameters for known in (SIMULATION, varied)]
    assert shown[0] is None and shown[1] is not None and float(shown[1].std()) > 0
