import math

import pytest
import torch

from astra_data.studies.motion import composed
from astra_data.studies.planar_walker import PlanarWalker, walk_command


def test_commands_are_the_published_ones() -> None:
    action = torch.tensor([[1.0, 1.0, 1.0, 0.0], [-1.0, -1.0, -1.0, 1.0], [9.0, 0.5, 0.0, 0.0]])
    expected = torch.tensor([[1.2564, 0.25, 0.2], [-1.2564, -0.075, -0.2], [1.2564, 0.15, 0.0]])
    torch.testing.assert_close(walk_command(action)[:, [2, 0, 1]], expected)


def test_a_turning_body_walks_a_circle() -> None:
    walker = PlanarWalker(1, timestep_s=0.1)
    start = torch.tensor([[1.0, 2.0, 0.7, 0.0, 0.0, 0.0, 3.0, 4.0]])
    walker.reset_to(start)
    around_s = 2 * math.pi / 1.2564
    turn = torch.tensor([[1.0, 1.0, 0.0, 0.0]])
    half = PlanarWalker(1, timestep_s=around_s / 2)
    half.reset_to(start)
    radius = 0.25 / 1.2564
    opposite = half.step(turn)[0]
    torch.testing.assert_close((opposite[:2] - start[0, :2]).norm(), torch.tensor(2 * radius))
    walker.timestep_s = around_s / 50
    for _ in range(50):
        walker.step(turn)
    torch.testing.assert_close(walker.state[0, :2], start[0, :2], atol=1e-5, rtol=0)
    torch.testing.assert_close(walker.state[0, 3:], torch.tensor([0.25, 0.0, 1.2564, 3.0, 4.0]))


@pytest.mark.parametrize("action", [[0.0, 1.0, -1.0, 0.0], [-0.7, -0.3, 0.5, 1.0]])
def test_it_moves_alike_everywhere(action: list[float]) -> None:
    walker = PlanarWalker(2, timestep_s=0.2)
    frame = torch.tensor([[3.0, -1.0, 2.5]])
    pose = torch.tensor([[0.3, 0.4, -0.6]])
    rest = torch.zeros(1, 5)
    walker.reset_to(torch.cat([torch.cat([pose, rest], 1), torch.cat([composed(frame, pose), rest], 1)]))
    here, there = walker.step(torch.tensor([action]).expand(2, 4))
    torch.testing.assert_close(composed(frame, here[None, :3]), there[None, :3])


def test_only_the_rows_asked_for_are_reset() -> None:
    walker = PlanarWalker(3, timestep_s=0.1)
    walker.reset_to(torch.ones(1, 8), torch.tensor([1]))
    assert walker.state.sum(1).tolist() == [0.0, 8.0, 0.0]
