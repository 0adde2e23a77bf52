from dataclasses import replace

import pytest
import torch
from small_cart import TASK as CART
from small_cart import Reach
from toy_episodes import toy_episodes

from astra_data.core.errors import BadInputError
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.grounding.replays import ReplayWindows, beginnings, trajectory_gaps
from astra_data.worlds.registry import TASKS
from astra_data.worlds.variation import PlanarVariation

TASK = TASKS["antmaze-umaze"]
LENGTHS = (7, 4, 2)


def episodes() -> PairedEpisodes:
    """Return three episodes whose entries name their episode and step: 10 episode + step."""
    number = 10.0 * torch.arange(3)[:, None] + torch.arange(7)
    mask = torch.stack([(torch.arange(7) < length).float() for length in LENGTHS])
    return toy_episodes(
        number.unsqueeze(-1).expand(3, 7, 4),
        100.0 + number.unsqueeze(-1).expand(3, 7, 2),
        next_state=200.0 + number.unsqueeze(-1).expand(3, 7, 4),
        mask=mask,
    )


def test_windows_begin_wherever_they_fit() -> None:
    episode, first = beginnings(episodes(), 4)
    assert list(zip(episode.tolist(), first.tolist(), strict=True)) == [
        (0, 0),
        (0, 1),
        (0, 2),
        (0, 3),
        (1, 0),
    ]
    assert len(beginnings(episodes(), 7)[0]) == 1
    with pytest.raises(BadInputError, match="at least 8 steps, the longest has 7: shorten `window`"):
        beginnings(episodes(), 8)


def test_a_window_holds_its_first_state_and_all_of_its_steps() -> None:
    cut = ReplayWindows.at(episodes(), torch.tensor([1, 0]), torch.tensor([0, 3]), 4)
    assert cut.state[:, 0].tolist() == [10.0, 3.0]
    assert cut.action[..., 0].tolist() == [[110.0, 111.0, 112.0, 113.0], [103.0, 104.0, 105.0, 106.0]]
    assert cut.next_state[..., 0].tolist() == [[210.0, 211.0, 212.0, 213.0], [203.0, 204.0, 205.0, 206.0]]


def test_windows_side_by_side_do_not_overlap() -> None:
    cut = ReplayWindows.side_by_side(episodes(), 2)
    assert cut.state[:, 0].tolist() == [0.0, 2.0, 4.0, 10.0, 12.0, 20.0]


def test_a_summary_leaves_out_the_place_in_a_maze() -> None:
    cut = ReplayWindows.at(episodes(), torch.tensor([0]), torch.tensor([1]), 3)
    assert cut.summary(TASK).tolist() == [[1.0, 1.0, 102.0, 102.0]]
    walker = TASKS["humanoid-kinematics"]
    size = walker.abstract_state.size
    state, action = torch.randn(2, size), torch.randn(2, 3, walker.objective.action_size)
    goal = state[:, :0]
    known = ReplayWindows(state, goal, action, state[:, None].expand(2, 3, size)).summary(walker)
    seen = walker.objective.observe(state, state[:, :0])
    torch.testing.assert_close(known, torch.cat([seen, action.mean(1)], dim=-1))


def test_a_summary_outside_of_a_maze_is_of_what_is_observed_with_the_goal() -> None:
    class Ahead(Reach):
        def observe(self, state: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
            return goal - state

    task = replace(CART, objective=Ahead(horizon=40))
    state = torch.arange(8.0).reshape(1, 8, 1)
    recorded = toy_episodes(state, torch.ones(1, 8, 1), next_state=state + 1, goal=state + 5)
    cut = ReplayWindows.at(recorded, torch.tensor([0, 0]), torch.tensor([2, 4]), 3)
    assert cut.goal.tolist() == [[7.0], [9.0]]
    assert cut.summary(task).tolist() == [[5.0, 1.0]] * 2


def test_gaps_are_mean_distances_from_the_recording() -> None:
    """The target moves at 0.8 of the command in the open: speeds and places are off in proportion."""
    start = torch.tensor([*TASK.maze.cell_center(1, 1), 0.0, 0.0]).float().expand(2, 4)
    action = torch.tensor([[0.5, 0.0], [-0.0, -1.0]])[:, None].expand(2, 4, 2)
    speed = torch.tensor([0.5, 1.0])
    along = torch.arange(1, 5) * TASK.timestep_s
    target = start[:, None] + torch.cat([0.8 * action * along[:, None], 0.8 * action], dim=-1)
    recorded = ReplayWindows(start, start[:, :2], action, target)
    factors = torch.tensor([1.0, 0.8, 0.6])
    plain = PlanarVariation().ranges()[:, 0]
    parameters = plain.repeat(3, 1)
    parameters[:, PlanarVariation().names.index("friction")] = factors
    gaps = trajectory_gaps(TASK, recorded, parameters, seed=0)
    assert gaps.shape == (3, 2, len(TASK.quantities))
    names = list(TASK.quantities)
    off = (factors - 0.8).abs()[:, None] * speed
    torch.testing.assert_close(gaps[..., names.index("velocity_m_s")], off, atol=1e-4, rtol=0)
    torch.testing.assert_close(gaps[..., names.index("position_m")], off * along.mean(), atol=1e-4, rtol=0)


def test_errors_to_either_side_add_up() -> None:
    """Commands go back and forth, so that the plain simulator is too fast in either direction."""
    start = torch.tensor([[*TASK.maze.cell_center(1, 1), 0.0, 0.0]]).float()
    action = torch.tensor([[0.5, 0.0], [-0.5, 0.0]]).repeat(2, 1)[None]
    moved = 0.8 * TASK.timestep_s * action.cumsum(1)
    target = torch.cat([start[:, None, :2] + moved, 0.8 * action], dim=-1)
    recorded = ReplayWindows(start, start[:, :2], action, target)
    (gap,) = trajectory_gaps(TASK, recorded, PlanarVariation().ranges()[:, 0][None], seed=0)
    assert float(gap[0, list(TASK.quantities).index("velocity_m_s")]) == pytest.approx(0.2 * 0.5, abs=1e-4)


def test_all_parameters_are_replayed_with_the_same_noise() -> None:
    start = torch.tensor([*TASK.maze.cell_center(1, 1), 0.0, 0.0]).float().expand(3, 4)
    action = torch.zeros(3, 5, 2)
    recorded = ReplayWindows(start, start[:, :2], action, start[:, None].expand(3, 5, 4))
    noisy = PlanarVariation(position_noise_m=(0.1, 0.1)).ranges()[:, 0].repeat(2, 1)
    gaps = trajectory_gaps(TASK, recorded, noisy, seed=1)
    assert gaps[0].abs().max() > 0.01
    assert torch.equal(gaps[0], gaps[1])
    assert torch.equal(trajectory_gaps(TASK, recorded, noisy, seed=1), gaps)
    assert not torch.equal(trajectory_gaps(TASK, recorded, noisy, seed=2), gaps)
