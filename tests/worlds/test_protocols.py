"""Every target keeps the promises of `TargetEnv` that collecting, evaluating and learning rely on."""

import inspect
from collections.abc import Mapping

import my_simulator
import numpy as np
import pytest
import torch

from astra_data.robots.registry import TASKS
from astra_data.worlds import protocols
from astra_data.worlds.protocols import BatchedEnv, Simulator, TargetEnv, TaskSimulator
from astra_data.worlds.task import Task

TARGETS = {name: TASKS[name] for name in ("antmaze-umaze", "nao-navigation", "nao-kick", "humanoid-extended")}
COUNT = 3


def target(name: str, seed: int = 0) -> TargetEnv:
    env = TARGETS[name].target(COUNT, seed=seed, num_threads=1)
    env.reset()
    return env


def actions(env: TargetEnv, steps: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return 2 * torch.rand(steps, COUNT, env.action_size, generator=generator) - 1


@pytest.mark.parametrize("name", TARGETS)
def test_shapes_and_types_are_those_of_the_protocol(name: str) -> None:
    env = target(name)
    for protocol in (BatchedEnv, TargetEnv):
        for member, value in vars(protocol).items():
            assert member.startswith("_") or not inspect.isfunction(value) or callable(getattr(env, member))
    observation = env.reset()
    step = env.step(actions(env, 1)[0])
    assert observation.shape == step.observation.shape == (COUNT, env.observation_size)
    assert env.num_envs == COUNT and env.position.shape[0] == COUNT and env.state.shape[0] == COUNT
    for values in (observation, step.observation, step.reward, env.state, env.position, env.goal):
        assert values.dtype == torch.float32
    for flags in (step.terminated, step.success, env.failed, env.wall_contact):
        assert flags.dtype == torch.bool and flags.shape == (COUNT,)
    assert step.reward.shape == (COUNT,)


@pytest.mark.parametrize("name", TARGETS)
def test_rows_outside_of_a_mask_go_on(name: str) -> None:
    env, other = target(name), target(name)
    for action in actions(env, 3):
        before = env.step(action).observation
        other.step(action)
    after = env.reset(torch.tensor([False, True, False]))
    assert (after == before).all(1).tolist() == [True, False, True]
    env.reset(torch.zeros(COUNT, dtype=torch.bool))
    state = env.state
    step = env.step(actions(env, 1)[0], torch.tensor([True, True, False]))
    assert torch.equal(env.state[2], state[2]) and not torch.equal(env.state[:2], state[:2])
    assert torch.equal(step.observation[2], after[2]) and float(step.reward[2]) == 0.0


@pytest.mark.parametrize("name", TARGETS)
def test_the_same_seed_gives_the_same_bytes(name: str) -> None:
    """Also after reseeding, in targets that were built with another seed and have moved."""

    def run(env: TargetEnv) -> bytes:
        seen = [env.reset()]
        for count, action in enumerate(actions(env, 5)):
            step = env.step(action)
            seen += [step.observation, step.reward]
            if count == 2:
                seen.append(env.reset(torch.tensor([True, False, True])))
        return b"".join(values.numpy().tobytes() for values in seen)

    expected, env = (run(TARGETS[name].target(COUNT, seed=5, num_threads=2)), target(name, seed=1))
    assert run(env) != expected
    env.reseed(5)
    assert run(env) == expected


@pytest.mark.parametrize("name", TARGETS)
def test_it_goes_on_from_a_saved_state(name: str) -> None:
    env, fresh = target(name), target(name)
    for action in actions(env, 4):
        env.step(action)
    fresh.reset()
    fresh.step(actions(env, 5)[4])
    saved = {key: values.clone() for key, values in env.state_dict().items()}
    first = [env.step(action) for action in actions(env, 3)]
    fresh.load_state_dict(saved)
    assert torch.equal(fresh.goal, env.goal)
    for step, action in zip(first, actions(env, 3), strict=True):
        again = fresh.step(action)
        assert torch.equal(again.observation, step.observation) and torch.equal(again.reward, step.reward)
        assert torch.equal(again.terminated, step.terminated)


@pytest.mark.parametrize("name", ["antmaze-umaze", "humanoid-extended"])
def test_a_target_set_to_a_recorded_state_shows_it(name: str) -> None:
    env = target(name)
    for action in actions(env, 3):
        env.step(action)
    recorded = env.state
    env.reset()
    env.reset_to(np.array([2, 0]), recorded[[2, 0]].double().numpy())
    assert torch.equal(env.state[[2, 0]], recorded[[2, 0]]) and not torch.equal(env.state[1], recorded[1])


def members(protocol: type) -> set[str]:
    """Return the names that a protocol asks for, those of its bases included."""
    names: set[str] = set()
    for base in protocol.__mro__[:-1]:
        if base.__module__ == protocols.__name__:
            own = {name for name in vars(base) if not name.startswith("_")}
            names |= own | set(inspect.get_annotations(base))
    return names


def test_a_user_writes_what_the_module_shows() -> None:
    assert members(Simulator) == {*("abstract_state", "abstraction", "parameters"), *("state", "reset_to", "step")}
    glider: Simulator = my_simulator.Glider(1)
    assert all(hasattr(glider, name) for name in members(Simulator))


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_every_task_has_a_simulator_of_the_kind_that_tasks_need(task: Task) -> None:
    simulator: TaskSimulator = task.simulator(3)
    assert all(hasattr(simulator, name) for name in members(TaskSimulator))
    state = simulator.state.clone()
    rows = torch.tensor([2])
    changed = state.clone()
    changed[2] = 0.9 * state[2]
    simulator.reset_to(changed[2:], rows)
    assert torch.equal(simulator.state, changed)
    simulator.reset_to(state)
    assert torch.equal(simulator.state, state) and not simulator.blocked.any() and simulator.blocked.shape == (3,)
    assert isinstance(simulator.parameters, Mapping)
    stepped = simulator.step(torch.zeros(3, task.objective.action_size))
    assert torch.equal(stepped, simulator.state) and stepped.dtype == torch.float32
    landed = simulator.settle(state, stepped)
    assert torch.equal(landed, simulator.state)
