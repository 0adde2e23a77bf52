from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.worlds.plane.mazes import LONG_MAZE, U_MAZE, GoalDistance, Maze
from astra_data.worlds.plane.navigation import Navigation, PlanarStates, PlanarTarget, PointMass, VariedPlanar
from astra_data.worlds.protocols import Step
from astra_data.worlds.variation import BallVariation, PlanarVariation

TASK = Navigation(U_MAZE, horizon=700)


def along(corners: list[list[float]], count: int) -> Tensor:
    """Return `count` points (count, 2) along a line through `corners`."""
    places = np.linspace(0, len(corners) - 1, count)
    columns = [np.interp(places, range(len(corners)), column) for column in zip(*corners, strict=True)]
    return torch.tensor(np.stack(columns, axis=-1), dtype=torch.float32)


def test_progress_adds_up_to_the_distance_gained() -> None:
    path = along([[-4, 4], [4, 4], [4, -4], [0, -4]], 120)
    goal = torch.tensor([[-4.0, -4.0]]).expand(119, 2)
    gained = TASK.reward(path[:-1], path[1:], goal, torch.zeros(119)).sum()
    # From two slanted legs around the inner wall's end to the last 4 m.
    assert float(gained) == pytest.approx(2 * np.hypot(6, 2) + 4 - 4, rel=0.04)


def test_success_and_toppling_are_paid_once_each() -> None:
    goal = torch.tensor([[-4.0, -4.0]]).expand(4, 2)
    position = goal + torch.tensor([[0.44, 0.0], [0.46, 0.0], [0.46, 0.0], [0.0, 0.46]])
    toppled = torch.tensor([False, False, True, False])
    assert TASK.reached(position, goal).tolist() == [True, False, False, False]
    reward = TASK.reward(position, position, goal, toppled)
    assert reward.tolist() == pytest.approx([10.0, 0.0, -10.0, 0.0], abs=1e-5)
    rim = goal[:1] + torch.tensor([[0.0, 0.5]])
    assert Navigation(U_MAZE, horizon=700, success_radius_m=0.5).reached(rim, goal[:1]).all()


def test_policies_see_shares_of_the_half_extent_and_waves_of_the_position() -> None:
    goal = torch.tensor([[-4.0, -4.0]]).expand(2, 2)
    state = torch.tensor([[5.0, 2.5, 0.0, 0.0], [-10.0, 10.0, 0.0, 0.0]])
    seen = Navigation(U_MAZE, horizon=700, position_waves=2).observe(state, goal)
    assert torch.equal(seen[:, :8], TASK.observe(state, goal))
    torch.testing.assert_close(seen[0, :8], torch.tensor([0.5, 0.25, 0.0, 0.0, -0.4, -0.4, -0.9, -0.65]))
    # The maze reaches from -10 to 10 m: a quarter and an eighth of a wave, then twice as much.
    sines, cosines = seen[0, 8:12].tolist(), seen[0, 12:].tolist()
    assert sines == pytest.approx([1.0, 0.5**0.5, 0.0, 1.0], abs=1e-6)
    assert cosines == pytest.approx([0.0, 0.5**0.5, -1.0, 0.0], abs=1e-6)


@pytest.mark.parametrize("maze", [U_MAZE, LONG_MAZE])
def test_starts_and_goals_scatter_around_their_cells(maze: Maze) -> None:
    task = Navigation(maze, horizon=1)
    for draw, cell in ((task.draw_starts, task.maze.start), (task.draw_goals, task.maze.goal)):
        points = draw(np.random.default_rng(0), 4000)[:, :2] - np.array(task.maze.cell_center(*cell))
        assert points.shape == (4000, 2) and points.mean(axis=0) == pytest.approx([0.0, 0.0], abs=0.02)
        assert points.std(axis=0) == pytest.approx([0.2, 0.2], abs=0.01) and np.abs(points).max() <= 0.6 + 1e-9


def test_goals_have_to_be_within_their_cell() -> None:
    narrow = replace(U_MAZE, scale=1.0)
    with pytest.raises(BadInputError, match=r"3 spread_m \+ path_clearance_m = 0.6 m around its center"):
        Navigation(narrow, horizon=1)
    with pytest.raises(BadInputError, match=r"goals within their cell of 1 m, got .* = 0.5 m"):
        Navigation(narrow, horizon=1, spread_m=0.1, path_clearance_m=0.2)
    Navigation(narrow, horizon=1, spread_m=0.11, path_clearance_m=0.1)
    distance = GoalDistance.of_maze(narrow, spacing_m=0.11, radius_m=0.1)
    rows, columns = narrow.fine_index(distance.lattice.double().numpy())
    # Each field is least at its own goal.
    assert [divmod(int(field.argmin()), 50) for field in distance.fields] == [*zip(rows, columns, strict=True)]


def test_paths_to_the_goal_keep_the_clearance() -> None:
    maze = replace(U_MAZE, scale=1.0, fine_m=0.05)
    distance = Navigation(maze, horizon=1, spread_m=0.05, path_clearance_m=0.25).goal_distance
    start, goal = (torch.tensor([maze.cell_center(*cell)]) for cell in (maze.start, maze.goal))
    # Along tangents of circles of 0.25 m around the inner wall's corners, which are 1 m apart.
    away = np.hypot(1.5, 0.5)
    bend = np.pi / 2 - np.arctan(0.5 / 1.5) + np.arcsin(0.25 / away)
    expected = 2 * np.sqrt(away**2 - 0.25**2) + 2 * 0.25 * bend + 1.0
    assert float(distance(start, goal)) == pytest.approx(expected, rel=0.04)


def test_starts_anywhere_cover_the_free_space_evenly_and_keep_clear_of_walls() -> None:
    points = TASK.draw_anywhere(np.random.default_rng(0), 7000)[:, :2]
    assert U_MAZE.clearance(points).min() > 0.8
    assert (points[:, 1] > 0).mean() == pytest.approx(0.5, abs=0.02)  # the two arms are mirror images
    arms = (np.abs(points[:, 1]) > 2).mean()
    # Arms of 10.4 m by 2.4 m (2 of them), and 5.6 m by 2.4 m of bend between them.
    assert arms == pytest.approx(2 * 10.4 * 2.4 / (2 * 10.4 * 2.4 + 4 * 2.4), abs=0.03)


class Straight(Navigation):
    """Progress is paid as the crow flies."""

    def goal_distance(self, position: Tensor, goal: Tensor) -> Tensor:
        return torch.as_tensor((position - goal).norm(dim=-1))


STRAIGHT = Straight(U_MAZE, horizon=10)
WALLED = Straight(U_MAZE, horizon=10, ends_at_walls=True)
START, GOAL = (np.array(U_MAZE.cell_center(*cell)) for cell in (U_MAZE.start, U_MAZE.goal))


class Dots(PlanarTarget):
    """Robots [x, y], the first of which leans on a wall."""

    place = torch.zeros(3, 2)

    @property
    def state(self) -> Tensor:
        return self.place

    @property
    def wall_contact(self) -> Tensor:
        return torch.tensor([True, False, False])


def judged(target: PlanarTarget, after: Sequence[Sequence[float]], fallen: Sequence[bool] = (False,) * 3) -> Step:
    """Return the outcome of a step from the origin, whose goals are at (1, 0)."""
    target.goal = torch.tensor([[1.0, 0.0]] * 3)
    return target._judged(torch.zeros(3, 2), torch.tensor(after), np.array(fallen))


def test_an_episode_ends_at_the_goal_or_in_a_fall() -> None:
    target = Dots(STRAIGHT, 3)
    step = judged(target, [[0.9, 0.0], [0.2, 0.0], [0.3, 0.0]], (False, True, False))
    assert step.success.tolist() == [True, False, False] and target.failed.tolist() == [False, True, False]
    assert step.terminated.tolist() == [True, True, False]
    # Meters closer to the goal, and 10 for reaching it or -10 for the fall.
    torch.testing.assert_close(step.reward, torch.tensor([10.9, 0.2 - 10.0, 0.3]))
    assert step.observation.tolist() == [[0.0, 0.0, 1.0, 0.0]] * 3


@pytest.mark.parametrize(("objective", "failed"), [(STRAIGHT, [False] * 3), (WALLED, [True, False, False])])
def test_walls_end_an_episode_where_the_objective_says_so(objective: Navigation, failed: list[bool]) -> None:
    target = Dots(objective, 3)
    step = judged(target, [[0.5, 0.0]] * 3)
    assert target.failed.tolist() == step.terminated.tolist() == failed
    torch.testing.assert_close(step.reward, 0.5 - 10.0 * torch.tensor(failed).float())
    assert judged(target, [[0.9, 0.0]] * 3).success.all() and not target.failed.any()  # at the goal, by a wall


HERE = torch.tensor([[-4.0, 5.85, 0.0, 0.0, 7.0]]).expand(3, 5)


class Resting(PlanarStates):
    """Stays where it is."""

    def step(self, action: Tensor) -> Tensor:
        return self.state


def resting(count: int, size: int) -> Resting:
    class Sized(Resting):
        state_size = size

    return Sized(U_MAZE, count, timestep_s=0.1, radius_m=0.1, speed_m_s=2.0)


def test_rows_are_set_by_themselves_and_states_handed_out_stay() -> None:
    states = resting(3, 5)
    states.reset_to(HERE)
    handed_out = states.state
    states.blocked[:] = True
    states.reset_to(HERE[:1] + 1.0, torch.tensor([1]))
    assert torch.equal(handed_out, HERE) and torch.equal(states.state[1], HERE[0] + 1.0)
    assert states.blocked.tolist() == [True, False, True]
    given = HERE.clone()
    states.reset_to(given)
    given.zero_()
    assert torch.equal(states.state, HERE)


@pytest.mark.parametrize(("fine_m", "radius_m"), [(0.25, 0.1), (0.1, 0.15), (0.1, 0.149), (0.1, 0.16)])
def test_a_radius_between_the_cells_of_the_maze_is_refused(fine_m: float, radius_m: float) -> None:
    expected = f"radius_m: expected a multiple of the maze's fine_m, {fine_m} m, got {radius_m}: take another"
    with pytest.raises(BadInputError, match=expected):
        PlanarStates(replace(U_MAZE, fine_m=fine_m), 1, timestep_s=0.1, radius_m=radius_m)


def test_steps_that_pass_through_walls_are_refused() -> None:
    assert PointMass(U_MAZE, 1, timestep_s=0.5, speed_m_s=4.0).parameters["speed_m_s"] == 4.0
    with pytest.raises(BadInputError, match=r"speed_m_s: expected steps of 2 m, half a cell of the maze, .* 2\.05 m"):
        PointMass(U_MAZE, 1, timestep_s=0.5, speed_m_s=4.1)


def test_corrections_keep_as_clear_of_walls_as_they_are_told_and_steps_do_not() -> None:
    """The wall's face is at 6 m; the disc's center comes as close as 0.1 m."""
    states = resting(3, 5)
    states.keep_clear(0.5)
    start = HERE.clone()
    start[:, 1] = 5.4
    landed = start.clone()
    landed[0, 1], landed[1, 1], landed[2, 0] = 5.7, 5.3, -3.5
    states.reset_to(start)
    settled = states.settle(start, landed)
    torch.testing.assert_close(settled[:, 1], torch.tensor([5.5, 5.3, 5.4]), atol=1e-3, rtol=0)
    torch.testing.assert_close(settled[:, 0], torch.tensor([-4.0, -4.0, -3.5]))
    # Who is stopped is as fast as it came on in the 0.1 s.
    torch.testing.assert_close(settled[:, 3], torch.tensor([1.0, 0.0, 0.0]), atol=1e-2, rtol=0)
    assert states.blocked.tolist() == [True, False, False]
    moved, stopped = states.free.slide(start[:, :2], landed[:, :2])
    torch.testing.assert_close(moved, landed[:, :2])
    assert not stopped.any()
    states.keep_clear(0.0)  # its radius is as close as it comes
    assert float(states.settle(start, start + torch.tensor([0.0, 0.58, 0.0, 0.0, 0.0]))[:, 1].max()) < 5.901


def test_corrections_slide_along_walls_and_keep_all_else() -> None:
    states = resting(3, 5)
    landed = HERE.clone()
    landed[0, 1], landed[1, 0], landed[:, 2:] = 5.95, -3.95, 0.5
    states.blocked[2] = True  # in the step before
    settled = states.settle(HERE, landed)
    assert states.blocked.tolist() == [True, False, True]
    # The wall's face is at 6 m, the disc's center stays 0.1 m away.
    assert 5.8 < settled[0, 1] < 5.9001 and torch.equal(settled[1:], landed[1:])
    assert torch.equal(settled[:, 2:], landed[:, 2:]) and settled is states.state


def test_commands_are_clipped_then_turned_then_scaled() -> None:
    states = resting(2, 4)
    command = torch.tensor([[3.0, 0.0], [0.5, -0.25]])
    torch.testing.assert_close(states.commanded_velocity(command), torch.tensor([[2.0, 0.0], [1.0, -0.5]]))
    plain = {"friction": 1.0, "action_scale": 0.0, "heading_bias_deg": 0.0, "timestep_scale": 1.0}
    columns = {name: torch.full((2, 1), value) for name, value in plain.items()}
    columns["friction"][1], columns["action_scale"][1], columns["heading_bias_deg"][0] = 0.5, 0.2, 90.0
    columns["timestep_scale"][1] = 3.0
    states.vary(columns)
    torch.testing.assert_close(
        states.commanded_velocity(command), torch.tensor([[0.0, 2.0], [0.6, -0.3]]), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(states.period_s, torch.tensor([[0.1], [0.3]]))


def test_sensors_show_other_states_than_the_true_ones() -> None:
    torch.manual_seed(0)
    names = ("position_noise_m", "velocity_noise_m_s", "ball_position_noise_m", "ball_velocity_noise_m_s")
    widths = {name: (width / 10, width / 10) for width, name in enumerate(names, start=1)}
    varied = VariedPlanar(inner := resting(3, 8), BallVariation(**widths))
    here = torch.rand(3, 8)
    varied.reset_to(here)
    assert torch.equal(varied.state, here)
    shown = torch.stack([varied.step(torch.zeros(3, 3)) for _ in range(500)]) - here
    assert torch.equal(varied.simulator.state, here) and torch.equal(inner.state, here)
    expected = torch.tensor([0.1, 0.1, 0.2, 0.2, 0.3, 0.3, 0.4, 0.4])
    torch.testing.assert_close(shown.amax((0, 1)), expected, atol=0, rtol=0.03)
    torch.testing.assert_close(shown.amin((0, 1)), -expected, atol=0, rtol=0.03)
    before = varied.state  # a row that is set is shown as it is; the others as before
    varied.reset_to(torch.zeros(1, 8), torch.tensor([1]))
    assert torch.equal(varied.state, torch.stack([before[0], torch.zeros(8), before[2]]))
    assert torch.equal(varied.simulator.state, torch.stack([here[0], torch.zeros(8), here[2]]))


PLACE = torch.tensor([[-4.0, 4.0, 0.0, 0.0]])
ACTION = torch.tensor([[0.6, -0.8]])


def point_mass(num_envs: int) -> PointMass:
    return PointMass(U_MAZE, num_envs, timestep_s=0.05)


def one_step(variation: PlanarVariation, count: int = 1, action: Tensor = ACTION) -> VariedPlanar:
    simulator = VariedPlanar(point_mass(count), variation)
    simulator.reset_to(PLACE.expand(count, 4))
    simulator.step(action.expand(count, 2))
    return simulator


def test_the_plain_point_mass_does_these_operations_in_this_order() -> None:
    """Recorded datasets hold its float32 states: no rounding may change."""
    torch.manual_seed(1)
    simulator = PointMass(U_MAZE, 100, timestep_s=0.192, speed_m_s=0.25)
    position = torch.tensor(U_MAZE.cell_center(*U_MAZE.start)).expand(100, 2)
    simulator.reset_to(torch.cat([position, torch.zeros(100, 2)], dim=-1))
    for _ in range(50):
        action = 2 * torch.randn(100, 2)
        state = simulator.step(action)
        moved, _ = simulator.free.slide(position, position + action.clamp(-1.0, 1.0) * 0.25 * 0.192)
        assert torch.equal(state, torch.cat([moved, (moved - position) / 0.192], dim=-1))
        position = moved


def test_each_parameter_does_what_its_name_says() -> None:
    plain = one_step(PlanarVariation())
    assert torch.equal(plain.state[0, 2:], plain.simulator.state[0, 2:])
    for variation, velocity, moved in (
        (PlanarVariation(friction=(0.5, 0.5)), [0.3, -0.4], [0.015, -0.02]),
        (PlanarVariation(action_scale=(0.5, 0.5)), [0.9, -1.2], [0.045, -0.06]),
        (PlanarVariation(heading_bias_deg=(90.0, 90.0)), [0.8, 0.6], [0.04, 0.03]),
        (PlanarVariation(timestep_scale=(2.0, 2.0)), [0.6, -0.8], [0.06, -0.08]),
    ):
        state = one_step(variation).state[0]
        torch.testing.assert_close(state[2:], torch.tensor(velocity), atol=1e-4, rtol=0)
        torch.testing.assert_close(state[:2] - PLACE[0, :2], torch.tensor(moved), atol=1e-5, rtol=0)


def test_noise_on_commands_moves() -> None:
    torch.manual_seed(0)
    noisy = one_step(PlanarVariation(action_noise=(0.1, 0.1)), 20_000, 0.5 * ACTION)
    assert torch.equal(noisy.state, noisy.simulator.state)
    torch.testing.assert_close(noisy.state[:, 2:].std(0), torch.full((2,), 0.1), atol=0.005, rtol=0)
