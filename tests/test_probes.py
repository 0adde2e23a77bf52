import math
from dataclasses import replace

import pytest
import torch
from probes import Probed, dropped_values, picking_split, probe, recent_actions, way_to_goal
from torch import Tensor
from toy_episodes import toy_episodes

from astra_data.dataset.columns import Column
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.worlds.plane.navigation import Navigation
from astra_data.worlds.registry import TASKS

STEPS = 2000


def probed(size: int, seed: int, noise: float = 1.0) -> tuple[Tensor, Tensor]:
    """Return inputs (N, 4), and values: a linear map of them, the same with noise, noise, a constant."""
    generator = torch.Generator().manual_seed(seed)
    inputs = 3.0 + 5.0 * torch.randn(size, 4, generator=generator)
    straight = inputs @ torch.tensor([1.0, -2.0, 0.0, 0.5]) - 7.0
    random = straight.std() * noise * torch.randn(2, size, generator=generator)
    return inputs, torch.stack([straight, straight + random[0], random[1], torch.ones(size)], dim=-1)


def test_r2_is_the_share_that_a_linear_map_explains() -> None:
    parts = [Probed(*(values.double() for values in probed(STEPS, seed))) for seed in range(3)]
    r2 = probe(*parts)
    assert float(r2[0]) == pytest.approx(1.0, abs=1e-6)
    assert float(r2[1]) == pytest.approx(0.5, abs=0.05)
    assert float(r2[2]) == pytest.approx(0.0, abs=0.02)
    assert r2[3].isnan()


def test_the_penalty_keeps_probes_of_few_steps_from_learning_noise_by_heart() -> None:
    """40 inputs that tell nothing, 60 steps to fit to: without a penalty R² is far below zero."""
    generator = torch.Generator().manual_seed(0)

    def draw(size: int) -> Probed:
        inputs = torch.randn(size, 41, generator=generator, dtype=torch.float64)
        return Probed(inputs, torch.stack([inputs[:, 0], torch.randn(size, generator=generator)], dim=-1))

    r2 = probe(draw(60), draw(200), draw(2000))
    assert float(r2[1]) > -0.05  # told from nothing: the largest penalty
    assert float(r2[0]) > 0.999  # of the same inputs: the least


def turned(yaw: float, lean: float) -> list[float]:
    """Return the quaternion of a body that leans forward by `lean`, then turns by `yaw`."""
    turn, tip = (math.cos(yaw / 2), math.sin(yaw / 2)), (math.cos(lean / 2), math.sin(lean / 2))
    return [turn[0] * tip[0], -turn[1] * tip[1], turn[0] * tip[1], turn[1] * tip[0]]


def ant(episodes: int = 6) -> PairedEpisodes:
    torch.manual_seed(0)
    target = torch.randn(episodes, 5, 29)
    target[..., 3:7] = torch.tensor(turned(2.5, 0.3))
    mask = torch.ones(episodes, 5)
    mask[0, 3:] = 0
    abstract = target[..., [0, 1, 15, 16]].clone()
    abstract[0, 3:] = 9.0  # padding tells nothing of what is dropped
    action = torch.arange(episodes * 10.0).reshape(episodes, 5, 2)
    return toy_episodes(abstract, action, next_state=abstract, mask=mask, target_state=target)


def test_what_is_dropped_has_names_and_rotations_are_yaw_and_lean() -> None:
    episodes = ant()
    values = dropped_values(TASKS["antmaze-umaze"].state, episodes)
    assert not {"x", "y", "vx", "vy", "qw", "qx", "qy", "qz"} & values.keys()
    assert torch.equal(values["ankle_4_rate"], episodes.target_state[..., 28])
    assert len(values) == 29 - 8 + 5
    lean = {"lean, x": -math.sin(0.3), "lean, y": 0.0, "lean, z": math.cos(0.3)}
    for name, expected in {"yaw, cosine": math.cos(2.5), "yaw, sine": math.sin(2.5), **lean}.items():
        torch.testing.assert_close(values[name], torch.full((6, 5), expected), msg=name)


def test_states_without_names_and_roles_are_numbered() -> None:
    episodes = ant()
    plain = dropped_values(Column("observation.state", size=29), episodes)
    assert [*plain] == [f"{entry}" for entry in range(29) if entry not in (0, 1, 15, 16)]
    roles = {"role": ["heading", *["invariant"] * 28]}
    headed = dropped_values(
        Column("observation.state", size=29, names=tuple(f"s{entry}" for entry in range(29)), astra=roles),
        episodes,
    )
    torch.testing.assert_close(headed["s0, sine"], episodes.target_state[..., 0].sin())


def test_recent_actions_are_those_before_the_step() -> None:
    episodes = ant()
    seen = recent_actions(episodes, 2)
    assert torch.equal(seen[..., :4], episodes.windows.state)
    assert seen[1, :, 4:].tolist() == [
        [0.0, 0.0, 0.0, 0.0],
        [10.0, 11.0, 0.0, 0.0],
        [12.0, 13.0, 10.0, 11.0],
        [14.0, 15.0, 12.0, 13.0],
        [16.0, 17.0, 14.0, 15.0],
    ]
    assert torch.equal(recent_actions(episodes, 0), episodes.windows.state)


def test_probes_see_real_steps_of_episodes_that_are_not_shared() -> None:
    episodes = ant()
    numbered = replace(episodes, target_state=torch.arange(6.0)[:, None, None].expand(6, 5, 29))
    parts = picking_split(numbered, seed=0)
    assert [len(part) for part in parts] == [5, 1]
    shown = [set(part.target_state[:, 0, 0].tolist()) for part in parts]
    assert not shown[0] & shown[1] and shown[0] | shown[1] == set(range(6))
    whole = Probed.of(episodes, episodes.windows.state, {"a": episodes.reward, "b": episodes.windows.mask})
    assert whole.inputs.shape == (28, 4) and whole.inputs.dtype == torch.float64
    assert whole.values[:, 1].tolist() == [1.0] * 28


def test_the_way_to_the_goal_cuts_the_corner_of_the_u() -> None:
    objective = TASKS["antmaze-umaze"].objective
    assert isinstance(objective, Navigation)
    # Half a cell before the inner corner, and half a cell behind it, the way leads there at 45 degrees.
    maze = objective.maze
    state = torch.zeros(1, 2, 4)
    state[0, :, :2] = torch.tensor([maze.cell_center(1, 2), maze.cell_center(2, 3)])
    goal = torch.tensor(maze.cell_center(*maze.goal)).float().expand(1, 2, 2)
    found = way_to_goal(objective, toy_episodes(state, torch.zeros(1, 2, 2), next_state=state, goal=goal))
    down = math.copysign(1.0, maze.cell_center(2, 3)[1] - maze.cell_center(1, 3)[1])
    way = torch.stack([found["way, x"][0], found["way, y"][0] * down], dim=-1)
    torch.testing.assert_close(way, torch.tensor([[1.0, 1.0], [-1.0, 1.0]]) / 2**0.5, atol=0.01, rtol=0)
