import inspect
from collections.abc import Mapping
from typing import Any

import my_simulator
import pytest
import torch
from torch import Tensor

from astra_data.robots.humanoid.walker2d import HumanoidWalker2d
from astra_data.robots.registry import TASKS
from astra_data.worlds import protocols
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.plane.point_mass import PointMass
from astra_data.worlds.protocols import RememberingSimulator, Simulator, TaskSimulator
from astra_data.worlds.task import Task


def members(protocol: type) -> set[str]:
    """Return the names that a protocol asks for, those of its bases included."""
    names: set[str] = set()
    for base in protocol.__mro__[:-1]:
        if base.__module__ == protocols.__name__:
            own = {name for name in vars(base) if not name.startswith("_")}
            names |= own | set(inspect.get_annotations(base))
    return names


def test_a_user_writes_what_the_module_shows() -> None:
    assert members(Simulator) == {
        *("abstract_state", "abstraction", "parameters"),
        *("state", "reset_to", "step"),
    }
    shown = protocols.__doc__ or ""
    assert all(name in shown for name in members(Simulator))
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
    assert torch.equal(simulator.state, state)
    assert not simulator.blocked.any() and simulator.blocked.shape == (3,)
    assert isinstance(simulator.parameters, Mapping)
    stepped = simulator.step(torch.zeros(3, task.objective.action_size))
    assert torch.equal(stepped, simulator.state) and stepped.dtype == torch.float32
    landed = simulator.settle(state, stepped)
    assert torch.equal(landed, simulator.state)


def test_only_the_walker_remembers_more_than_its_state() -> None:
    plain: Any = PointMass(U_MAZE, 2, timestep_s=0.05)
    assert not isinstance(plain, RememberingSimulator)
    walker: Any = HumanoidWalker2d(2, num_threads=1)
    assert isinstance(walker, RememberingSimulator)
    memory: Tensor = walker.memory
    assert memory.shape == (2, 1)
