from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_hex

from astra_data.reports.figures.motion import Panel, dynamics_mismatch, trajectories
from astra_data.reports.figures.style import DEPLOYED, SIMULATED
from astra_data.worlds.plane.mazes import U_MAZE


def panel(method: str, *, in_simulator: bool = True) -> Panel:
    target = np.full((3, 10, 2), np.nan)
    target[0] = np.linspace([-4, 4], [4, 4], 10)
    target[1, :4] = np.linspace([-4, 4], [0, 4], 4)
    target[2, :6] = np.linspace([-4, 4], [1, 4], 6)
    simulated = target[:1] if in_simulator else np.empty((0, 1, 2))
    return Panel(
        method=method,
        success=1 / 3,
        target=target,
        target_success=np.array([True, False, False]),
        simulated=simulated,
        simulated_success=np.ones(len(simulated), dtype=bool),
        goal=np.full((3, 2), -4.0),
    )


def test_trajectories_draw_a_panel_per_row_with_crosses_where_episodes_fail() -> None:
    figure = trajectories(U_MAZE, [panel("astra"), panel("follower", in_simulator=False)])
    told = [text.get_text() for text in figure.legends[0].get_texts()]
    assert told[1] == "in the target"
    elsewhere = trajectories(U_MAZE, [panel("astra")], "in a simulator").legends[0].get_texts()
    assert elsewhere[1].get_text() == "in a simulator"
    astra, follower = figure.axes
    assert (astra.get_title(loc="left"), astra.get_title(loc="right")) == ("ASTRA", "0.33")
    assert follower.get_title(loc="left") == "Careful follower"
    paths = [line for line in astra.lines if line.get_linestyle() != "None"]
    looks = [(line.get_color(), line.get_linestyle()) for line in paths]
    assert looks == [(DEPLOYED, "-")] * 3 + [(SIMULATED, "--")]
    crosses = [line for line in astra.lines if line.get_marker() == "x" and line.get_color() == DEPLOYED]
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in crosses] == [(0.0, 4.0), (1.0, 4.0)]  # type: ignore[index]
    assert sum(line.get_marker() == "*" for line in astra.lines) == 1
    assert not [line for line in follower.lines if line.get_color() == SIMULATED]
    (walls,) = astra.collections
    assert len(walls.get_paths()) == len(U_MAZE.wall_cells())


def test_dynamics_mismatch_draws_mean_and_two_bands_for_x_y_and_speed() -> None:
    time_s = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
    simulated = np.tile([1.0, 2.0, 3.0, 4.0], (5, 1))
    target = np.stack([simulated, simulated + 1])
    target[1, 4] = np.nan
    figure = dynamics_mismatch(time_s, np.zeros((5, 2)), simulated, target)
    x, y, speed, command = figure.axes
    labels = [axes.get_ylabel() for axes in (x, y, speed, command)]
    assert labels == ["x (m)", "y (m)", "speed (m/s)", "command (±1 per axis)"]
    for axes in (x, y, speed):
        assert len(axes.collections) == 2
        assert len(axes.lines) == 2
    # A command holds during the step that ends at its time.
    assert [line.get_drawstyle() for line in command.lines] == ["steps-pre"] * 2
    mean, one = x.lines
    assert np.asarray(mean.get_ydata()).tolist() == [1.5, 1.5, 1.5, 1.5, 1.0]
    assert [to_hex(str(line.get_color())) for line in (mean, one)] == [DEPLOYED.lower(), SIMULATED.lower()]
    assert np.asarray(speed.lines[1].get_ydata()).tolist() == [5.0] * 5


def test_a_star_stands_at_the_mean_goal_of_each_cell_and_a_ball_has_a_path_of_its_own() -> None:
    goals = np.array([[-4.0, -4.0], [-3.0, -3.6], [4.0, 4.0]])
    one = panel("astra", in_simulator=False)
    with_ball = np.concatenate([one.target, one.target + 0.5], axis=-1)
    figure = trajectories(U_MAZE, [replace(one, target=with_ball, goal=goals)])
    (axes,) = figure.axes
    stars = [line.get_xydata() for line in axes.lines if line.get_marker() == "*"]
    assert np.concatenate(stars) == pytest.approx(np.array([[-3.5, -3.8], [4.0, 4.0]]))
    dotted = [line for line in axes.lines if line.get_linestyle() == ":"]
    np.testing.assert_allclose(np.asarray(dotted[0].get_xydata()), one.target[0] + 0.5)


def test_rows_of_mazes_are_four_wide_and_long_titles_small() -> None:
    names = ["direct_transfer_iql_plus", *(f"m{number}" for number in range(4))]
    figure = trajectories(U_MAZE, [panel(name, in_simulator=False) for name in names])
    grid = figure.axes[0].get_subplotspec()
    assert grid is not None and grid.get_gridspec().get_geometry() == (2, 4)
    sizes = [axes._left_title.get_fontsize() for axes in figure.axes[:2]]  # type: ignore[attr-defined]
    assert sizes[0] < sizes[1] == 10.0


def test_each_axis_of_a_mismatch_has_its_own_values_and_bands() -> None:
    time_s = np.array([0.1, 0.2, 0.3])
    simulated = np.tile([1.0, 2.0, 3.0, 4.0], (3, 1))
    # 101 robots, a meter apart in x, two in y.
    shift = np.arange(101.0)[:, None, None] * np.array([1.0, 2.0, 0.0, 0.0])
    command = np.tile([0.8, -0.5], (3, 1))
    x, y, _, sent = dynamics_mismatch(time_s, command, simulated, simulated + shift).axes
    for axes, at, apart in ((x, 1.0, 1.0), (y, 2.0, 2.0)):
        mean, one = (np.asarray(line.get_ydata()) for line in axes.lines)
        assert one == pytest.approx(at) and mean == pytest.approx(at + 50 * apart)
        for band, alpha, ends in zip(axes.collections, (0.18, 0.32), ((5, 95), (25, 75)), strict=True):
            heights = np.asarray(band.get_paths()[0].vertices)[:, 1]
            assert band.get_alpha() == alpha
            assert [heights.min(), heights.max()] == pytest.approx([at + apart * end for end in ends])
    assert {line.get_linestyle(): np.asarray(line.get_ydata())[0] for line in sent.lines} == {
        "-": 0.8,
        ":": -0.5,
    }
