import numpy as np
import pytest
import torch
from torch import Tensor

from astra_data.policies.collecting import RandomCommands, StressCommands, WallWatch
from astra_data.robots.registry import task_named

TASK = task_named("nao-navigation")
HOLD = (3, 16)
STARTS = torch.tensor([[-1.5, 2.0], [0.0, 2.0], [1.5, 1.0], [0.0, 0.0]])
"""Middles of corridors of the maze, which are 1 m wide."""


def believed(position: Tensor) -> Tensor:
    state = torch.zeros(len(position), 29)
    state[:, :2] = position
    return state


def nearest(behavior: RandomCommands) -> float:
    """Return the least clearance in m of robots that do exactly as they are told for a minute."""
    simulator = TASK.simulator(len(STARTS))
    simulator.reset_to(torch.cat([STARTS, torch.zeros_like(STARTS)], dim=-1))
    behavior.start(range(len(STARTS)), seed=0)
    least = np.inf
    for _ in range(310):
        action = behavior.act(believed(simulator.state[:, :2]), torch.zeros(len(STARTS), 2))
        position = simulator.step(action)[:, :2].double().numpy()
        least = min(least, TASK.maze.clearance(position).min())
    return least


def test_a_watch_foresees_the_clearance_of_a_second() -> None:
    toward, along = [0.0, 1.0], [1.0, 0.0]
    clearance = WallWatch(TASK, 0.2).clearance(believed(STARTS[1:2]), np.array([[toward, along]]))
    # 0.25 m/s for five steps of 0.192 s, on a grid of 0.05 m.
    assert clearance.shape == (1, 2) and clearance[0] == pytest.approx([0.5 - 0.24, 0.5], abs=0.051)


def test_commands_that_are_watched_keep_clear_of_walls() -> None:
    assert nearest(RandomCommands(2, HOLD)) < 0.2
    assert nearest(RandomCommands(2, HOLD, WallWatch(TASK, 0.25))) >= 0.25 - 1e-6


def test_a_robot_that_is_too_near_is_led_away() -> None:
    behavior = RandomCommands(2, HOLD, WallWatch(TASK, 0.3))
    behavior.start(range(64), seed=0)
    near = torch.tensor([[0.0, 2.35]]).expand(64, 2)
    command = behavior.act(believed(near), torch.zeros(64, 2))
    assert float(command[:, 1].max()) < 0.0


def test_commands_are_held_and_repeat_with_the_seed() -> None:
    first, second = RandomCommands(2, (4, 4)), RandomCommands(2, (4, 4))
    first.start(range(5), seed=1)
    second.start(range(5), seed=1)
    state = believed(torch.zeros(5, 2))
    commands = torch.stack([first.act(state, state[:, :2]) for _ in range(8)])
    assert torch.equal(commands, torch.stack([second.act(state, state[:, :2]) for _ in range(8)]))
    assert torch.equal(commands[:1].expand(4, 5, 2), commands[:4]) and not torch.equal(commands[3], commands[4])


def commands_of(behavior: RandomCommands, steps: int) -> Tensor:
    """Return the commands (steps, B, A) of a behavior that was started."""
    return torch.stack([behavior.act(torch.zeros(200, 47), torch.zeros(200, 0)) for _ in range(steps)])


def test_stress_commands_are_at_the_bounds_and_half_of_them_reverse_the_one_before() -> None:
    behavior = StressCommands(3, (1, 1))
    behavior.start(range(200), seed=0)
    commands = commands_of(behavior, 20)
    assert torch.allclose(commands.abs().amax(-1), torch.ones(20, 200)) and (commands[0] != 0).all()
    is_reversed = (commands[1:] == -commands[:-1]).all(-1)
    assert 0.45 < float(is_reversed.float().mean()) < 0.55
    new = commands[1:][~is_reversed]
    assert float(new.mean(0).abs().max()) < 0.1
    assert float((new.abs() == 1).float().mean()) == pytest.approx(1 / 3, abs=0.01)
