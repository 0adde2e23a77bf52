import torch

from astra_data.policies.episodes import RecordedRange
from astra_data.worlds.commands import Commands

LIMITS = Commands({"v": (-1.0, 3.0), "w": (-2.0, 2.0)})


def test_steps_of_active_robots_beyond_any_axis_are_counted() -> None:
    asked = RecordedRange(torch.tensor([0.0, -1.0]), torch.tensor([1.0, 1.0]), LIMITS)
    commands = torch.tensor([[0.5, 0.0], [1.005, -1.01], [1.2, 0.0], [0.5, -1.2], [-0.02, 0.0], [3.0, 2.0]])
    active = torch.tensor([True, True, True, True, True, False])
    asked.count(LIMITS.normal(commands), active)
    assert asked.share == 3 / 5
    asked.count(torch.full((6, 2), -0.5), torch.ones(6, dtype=torch.bool))  # v = 0, w = -1: at the edge
    assert asked.share == 3 / 11
    asked.count(torch.full((1, 2), -40.0), torch.ones(1, dtype=torch.bool))  # is given as the least command
    assert asked.share == 4 / 12
