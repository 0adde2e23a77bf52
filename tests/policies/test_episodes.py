import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
import torch
from constant_policy import Constant
from rail_run import rail_run
from small_cart import TASK as CART
from small_cart import Last
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.grounding.files import load_grounding
from astra_data.grounding.simulator import NO_GROUNDING, FittedGrounding
from astra_data.policies import episodes as judging
from astra_data.policies.episodes import (
    Act,
    EpisodeRecord,
    ObservedTargetEnv,
    RecordedRange,
    in_simulator,
    in_target,
    reached_in_own_world,
    started,
)
from astra_data.policies.networks import ActorCritic, PolicyShape, UserPolicy
from astra_data.policies.running_policy import Observed, PolicyFile, RunningPolicy, running
from astra_data.policies.simulator_env import Simulation, SimulatorEnv, WorldConfig, training_env
from astra_data.robots.registry import TASKS
from astra_data.worlds.commands import Commands
from astra_data.worlds.task import Task


def flags(*values: int) -> Tensor:
    return torch.tensor(values, dtype=torch.bool)


def test_what_happens_after_the_end_does_not_count() -> None:
    record = EpisodeRecord(torch.zeros(3, 2), torch.zeros(3, 0))
    none = flags(0, 0, 0)
    for step, (success, failed, contact, reward) in enumerate(
        [
            (none, none, flags(1, 1, 0), [1.0, 2.0, 4.0]),
            (flags(1, 0, 0), none, none, [1.0, 2.0, 4.0]),
            (none, flags(1, 1, 0), flags(1, 1, 1), [math.nan, 2.0, 4.0]),
        ]
    ):
        record.add(torch.full((3, 2), float(step + 1)), torch.tensor(reward), success, failed, contact)
    assert record.active.tolist() == [False, False, True] and record.total_steps == 3 + 3 + 2
    outcome = record.outcome()
    assert outcome.to_json() == {
        "success": [1.0, 0.0, 0.0],
        "failed": [0.0, 1.0, 0.0],
        "wall_contact": torch.tensor([1 / 2, 2 / 3, 1 / 3]).tolist(),
        "steps": [2.0, 3.0, 3.0],
        "return": [2.0, 6.0, 12.0],
    }
    assert outcome.position[:, :, 0].nan_to_num(-1.0).tolist() == [[0, 1, 2, -1], [0, 1, 2, 3], [0, 1, 2, 3]]


LIMITS = Commands({"v": (-1.0, 3.0), "w": (-2.0, 2.0)})


def test_steps_of_active_robots_beyond_any_axis_are_counted() -> None:
    asked = RecordedRange(torch.tensor([0.0, -1.0]), torch.tensor([1.0, 1.0]), LIMITS)
    commands = torch.tensor([[0.5, 0.0], [1.005, -1.015], [1.2, 0.0], [0.5, -1.2], [-0.02, 0.0], [3.0, 2.0]])
    active = torch.tensor([True, True, True, True, True, False])
    asked.count(LIMITS.normal(commands), active)
    assert asked.share == 3 / 5
    asked.count(torch.full((6, 2), -0.5), torch.ones(6, dtype=torch.bool))  # v = 0, w = -1: at the edge
    assert asked.share == 3 / 11
    asked.count(torch.full((1, 2), -40.0), torch.ones(1, dtype=torch.bool))  # is given as the least command
    assert asked.share == 4 / 12


def driving(speed: float) -> Act:
    """Return actions of a speed in m/s, of commands from -1 to 4."""
    return lambda state, goal: torch.full_like(goal, (speed - 1.5) / 2.5)


def test_episodes_end_in_success_in_failure_or_with_their_time() -> None:
    there = in_target(CART, lambda goal: driving(0.9), 5, seed=3)
    assert there.success == [1.0] * 5 and there.failed == [0.0] * 5
    tipped = in_target(CART, lambda goal: driving(3.5), 5, seed=3)
    assert tipped.failed == [1.0] * 5 and tipped.steps == [1] * 5
    late = in_target(CART, lambda goal: driving(-0.5), 5, seed=3)
    assert late.success == [0.0] * 5 and late.steps == [CART.objective.horizon] * 5
    other = in_target(CART, lambda goal: driving(3.5), 5, seed=4)
    assert torch.equal(late.goal, tipped.goal)
    assert not torch.equal(other.goal, tipped.goal)


@pytest.mark.parametrize("task", [CART, TASKS["nao-navigation"], TASKS["humanoid-walker2d"]])
def test_only_the_ant_has_legs_of_several_lengths(task: Task) -> None:
    expected = rf"leg_scale: {task.name} has legs of one length: expected 1, got 1\.25"
    with pytest.raises(BadInputError, match=expected):
        in_target(task, lambda goal: driving(0.9), 1, seed=3, leg_scale=1.25)


SIMULATION = Simulation(WorldConfig())
SPEED = 4.0


def test_the_goals_are_those_of_the_seed_in_any_simulator() -> None:
    acting = running(CART, constant(1.0), NO_GROUNDING)
    begin = partial(started, acting, acting.act_in_simulator)
    asked = RecordedRange(torch.tensor([0.0]), torch.tensor([2.0]), CART.limits)
    runs = [
        in_simulator(training_env(CART, simulation, NO_GROUNDING, num_envs=9), begin, 40, seed, None if seed else asked)
        for simulation in (SIMULATION, Simulation(WorldConfig(), CART.varied.randomized))
        for seed in (0, 1)
    ]
    goals = [outcome.goal for outcome in runs]
    assert torch.equal(goals[0], goals[2]) and not torch.equal(goals[0], goals[1])
    outcome = runs[0]
    # It stops where the last episode ends; every command of 4 m/s is beyond 2 m/s.
    assert outcome.position.shape[1] - 1 == max(outcome.steps) <= 5 and asked.share == 1.0
    assert outcome.steps == [int(torch.ceil(goal / (0.1 * SPEED) - 1e-4)) for goal in goals[0][:, 0]]
    assert fmean(outcome.success) == 1.0


def test_where_it_is_to_last_an_episode_succeeds_in_its_last_step() -> None:
    world = training_env(replace(CART, objective=Last(horizon=6)), SIMULATION, NO_GROUNDING, num_envs=3)
    found = in_simulator(world, lambda goal: lambda state, goal: torch.full_like(goal, -0.6), 6, seed=0)
    assert found.success == [1.0] * 3 and found.steps == [6] * 3
    tested = in_target(replace(CART, objective=Last(horizon=6)), lambda goal: driving(0.0), 3, seed=0)
    assert tested.success == [1.0] * 3 and tested.steps == [6] * 3


def constant(command: float, simulation: Simulation = SIMULATION) -> PolicyFile:
    return PolicyFile(UserPolicy(Constant(command), 2, 1), simulation, None, None)


def test_what_it_reaches_is_what_the_simulator_s_rule_says() -> None:
    """Forward at 0.4 m a step, goals from 1 to 2 m, uniform: 3, 4 or 5 steps; 4.2 on average."""
    assert running(CART, constant(1.0, Simulation(WorldConfig(command_limit=0.5)))).command_limit == 0.5
    reached = reached_in_own_world(CART, constant(1.0), NO_GROUNDING, seed=0)
    assert reached.success == 1.0 and reached.steps == pytest.approx(4.2, abs=0.2)
    # At 0.4 m/s goals up to 1.6 m are in reach in 4 s.
    some = reached_in_own_world(CART, constant(-0.44), NO_GROUNDING, seed=0)
    assert some.success == pytest.approx(0.6, abs=0.15)
    assert some.steps == pytest.approx(32.5, abs=1.5)  # of those that arrive, in 25 to 40
    none = reached_in_own_world(CART, constant(-1.0), NO_GROUNDING, seed=0)
    assert (none.success, none.steps) == (0.0, 40.0)
    assert reached_in_own_world(CART, constant(-0.44), NO_GROUNDING, seed=1) != some


def test_a_policy_that_knows_no_simulator_cannot_be_tried() -> None:
    trained = PolicyFile(UserPolicy(Constant(1.0), 2, 1), None, None, None)
    with pytest.raises(BadInputError, match=r"tries: expected a policy that knows its simulator"):
        reached_in_own_world(CART, trained, NO_GROUNDING, seed=0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rail_run(tmp_path_factory, seeds=[0], methods=["nas"])


@pytest.fixture
def judge(folder: Path) -> FittedGrounding:
    return load_grounding(folder / "ground/nas/seed_0/grounding.safetensors")


@pytest.fixture
def policy(folder: Path, judge: FittedGrounding) -> RunningPolicy:
    return running(CART, PolicyFile.load(folder / "train/nas/seed_0/policy.safetensors"), judge)


@pytest.mark.usefixtures("quick_fits")
def test_failures_are_drawn_in_the_whole_simulator_of_the_grounding(
    judge: FittedGrounding, policy: RunningPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = list[tuple[SimulatorEnv, int, int]]()

    def seen(world: SimulatorEnv, begin: object, horizon: int, seed: int, starts: None) -> object:
        made.append((world, horizon, seed))
        raise StopIteration

    monkeypatch.setattr(judging, "in_simulator", seen)
    with pytest.raises(StopIteration):
        judging.judged_success(CART, judge, policy, 5, 7)
    world, horizon, seed = made[0]
    assert (world.num_envs, horizon, seed) == (5, CART.objective.horizon, 7)
    used: Any = world.simulator
    whole: Any = judge
    assert world.draws_failures and whole.failures is not None and whole.scatter_model is not None
    assert (used.failures, used.scatter_model) == (whole.failures, whole.scatter_model)


@pytest.mark.usefixtures("quick_fits")
def test_success_is_judged_from_each_start_alone(
    judge: FittedGrounding, policy: RunningPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, goal = torch.tensor([[0.0], [5.0], [0.25]]).double(), torch.tensor([[1.0], [1.5], [2.0]]).double()
    begun, run = list[dict[str, Tensor]](), judging.in_simulator

    def seen(world: SimulatorEnv, begin: Any, *given: Any, **more: Any) -> object:
        def noted(goal: Tensor) -> Any:
            begun.append({"state": world.simulator.state.clone(), "goal": goal.clone()})
            return begin(goal)

        return replace(run(world, noted, *given, **more), success=[1.0, 1.0, 0.0] * 9 + [1.0, 0.0, 0.0])

    monkeypatch.setattr(judging, "in_simulator", seen)
    assert judging.judged_from(CART, judge, policy, state, goal, 7).tolist() == pytest.approx([1.0, 0.9, 0.0])
    assert torch.equal(begun[0]["state"], state.float().repeat(10, 1))
    assert torch.equal(begun[0]["goal"], goal.float().repeat(10, 1))
    monkeypatch.setattr(judging, "in_simulator", run)
    assert judging.judged_from(CART, judge, policy, state, goal, 7)[1] == 1.0  # where it begins beyond its goal


TASK = TASKS["antmaze-umaze"]


def recorded() -> tuple[Tensor, Tensor]:
    """Return moments of two episodes that walked, with goals of their own."""
    env = TASK.target(2, seed=4, num_threads=1)
    env.reset()
    states = []
    for _ in range(5):
        states.append(env.state)
        env.step(torch.tensor([[1.0, 0.0], [0.0, -1.0]]))
    return torch.cat(states), torch.tensor([[3.0, -4.0], [-4.0, 1.0]]).repeat(5, 1)


def world(observed: Observed = "full", share: float = 0.0, count: int = 4, threads: int = 1) -> ObservedTargetEnv:
    starts = recorded() if share else None
    return ObservedTargetEnv(TASK, count, observed=observed, starts=starts, data_start_share=share, num_threads=threads)


def stretch(env: ObservedTargetEnv, count: int, seed: int) -> list[Tensor]:
    """Act at random for `count` steps; rows 1 and 3 start anew in the midst of it."""
    torch.manual_seed(seed)
    seen = []
    for step in range(count):
        outcome = env.step(2 * torch.rand(4, 2) - 1)
        seen += [outcome.observation, outcome.reward, outcome.terminated]
        if step == count // 2:
            seen.append(env.reset(torch.tensor([False, True, False, True])))
    return seen


@pytest.mark.parametrize("threads", [1, 2])
def test_going_on_from_a_saved_state_is_exact(threads: int) -> None:
    torch.manual_seed(1)
    env = world(share=0.5)
    env.reset()
    stretch(env, 12, seed=2)
    saved = {name: values.clone() for name, values in env.state_dict().items()}
    expected = stretch(env, 12, seed=3)
    torch.manual_seed(9)
    other = world(share=0.5, threads=threads)
    other.reset()
    other.load_state_dict(saved)
    for values, again in zip(expected, stretch(other, 12, seed=3), strict=True):
        assert torch.equal(values, again)


def test_all_episodes_start_from_moments_with_their_goals_where_the_share_is_one() -> None:
    torch.manual_seed(0)
    env, (states, goals) = world(share=1.0), recorded()
    env.reset()
    saved = env.state_dict()
    for state, goal in zip(saved["physics"][:, 1:30].float(), saved["goal"], strict=True):
        found = (states - state).abs().amax(1) < 1e-4
        assert found.any() and (goals[found] == goal).all()
    env.step(torch.ones(4, 2))
    before = env.state_dict()["physics"].clone()
    env.reset(torch.tensor([False, True, False, True]))
    assert (env.state_dict()["physics"] != before).any(1).tolist() == [False, True, False, True]


def test_all_of_the_state_is_observed_in_full_and_the_planar_part_otherwise() -> None:
    state = recorded()[0][7]
    goal = torch.tensor([4.0, 0.0])
    shown: dict[Observed, list[int]] = {"abstract": [0, 1, 15, 16], "full": list(range(29))}
    for observed, entries in shown.items():
        env = world(observed, count=1)
        assert env.observation_size == (8 if observed == "abstract" else 33)

        def observe(state: Tensor, env: ObservedTargetEnv = env) -> Tensor:
            # The physics has the state in doubles; its clock, first, is not observed.
            saved = env.state_dict() | {"goal": goal[None]}
            saved["physics"][:, 1:30] = state.double()
            return env.load_state_dict(saved)[0]

        before = observe(state)
        moved = [not torch.equal(observe(state + 0.1 * unit), before) for unit in torch.eye(29)]
        assert [entry for entry, is_moved in enumerate(moved) if is_moved] == entries and before.abs().max() < 3


def test_a_deployed_policy_sees_what_it_saw_in_training() -> None:
    torch.manual_seed(0)
    env = world("full")
    before, observation = env.reset(), env.reset()
    assert (before != observation).any(1).all()  # each begins anew
    policy = ActorCritic(PolicyShape(33, 2))
    deployed = RunningPolicy(TASK, policy, observed="full")
    assert deployed.observation_size == 33
    deployed.start(4)
    expected, _ = policy.policy(observation)
    saved = env.state_dict()
    with torch.no_grad():
        assert torch.equal(deployed.act(saved["physics"][:, 1:30].float(), saved["goal"]), expected)
