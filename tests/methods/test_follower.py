import numpy as np
import torch

from astra_data.grounding.simulator import EpisodeSimulator
from astra_data.methods.follower import careful
from astra_data.policies.simulator_env import SimulatorEnv
from astra_data.robots.registry import TASKS


def test_the_follower_reaches_the_goal_and_keeps_away_from_the_walls() -> None:
    task = TASKS["antmaze-umaze"]
    navigation, maze = task.objective, task.maze
    rng = np.random.default_rng(0)
    goal = torch.from_numpy(navigation.draw_goals(rng, 3)).float()
    simulator = task.simulator(3)
    start = torch.from_numpy(navigation.draw_starts(rng, 3)).float()
    simulator.reset_to(torch.cat([start, torch.zeros(3, 2)], dim=-1))
    act = careful(task, goal)
    reached = torch.zeros(3, dtype=torch.bool)
    closest = np.inf
    for _ in range(navigation.horizon):
        command = act(simulator.state, goal)
        assert command.abs().max() <= 1.0 + 1e-6
        place = simulator.step(command)[:, :2]
        reached |= navigation.reached(place, goal)
        closest = min(closest, float(maze.clearance(place.numpy().astype(np.float64)).min()))
        if reached.all():
            break
    assert reached.all() and closest > 1.0


def test_the_careful_kicker_scores_from_every_start_of_its_simulator() -> None:
    task = TASKS["nao-kick"]
    torch.manual_seed(0)
    world = SimulatorEnv(task.objective, EpisodeSimulator(task.simulator(100)))
    world.reset()
    act = careful(task, world.goal)
    rolling, ahead = (torch.tensor([[0.0] * 4 + [x, 0.1, v, 0.0]]) for x, v in ((0.3, 0.4), (0.7, 0.0)))
    torch.testing.assert_close(act(rolling, world.goal[:1]), act(ahead, world.goal[:1]))  # to where it will be
    scored, ended = torch.zeros(2, 100, dtype=torch.bool)
    for _ in range(task.objective.horizon):
        step = world.step(act(world.simulator.state, world.goal))
        scored |= step.success & ~ended
        ended |= step.terminated
    assert scored.float().mean() >= 0.98
