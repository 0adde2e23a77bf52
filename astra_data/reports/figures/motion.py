"""Where policies go: trajectories in the maze, and identical commands in simulator and target."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from astra_data.core.arrays import Bools, Floats
from astra_data.reports.figures.style import DEPLOYED, FAINT, INK, SIMULATED, WALL, method_title, style
from astra_data.worlds.plane.mazes import Maze

COLUMNS = 4
"""Panels side by side, at most."""

PANEL_INCHES = 2.0
"""Width of a panel."""

TITLE_POINTS = 10.0
"""Font size of a panel's title; one of more than `TITLE_LETTERS` letters is smaller."""

TITLE_LETTERS = 17

RIM = 0.35
"""Visible width of the outer walls, in cells."""


@dataclass(frozen=True)
class Panel:
    """One row's episodes; positions in m of the robot, and of its ball if it has one; NaN after the end.

    Attributes:
        method: name of the row.
        success: the row's success rate in the target, over all its episodes.
        target: positions in the target, (N, T, 2) or (N, T, 4).
        target_success: which of them reached the goal, (N,).
        simulated: positions in the simulator that the policy was trained in, likewise (M, ...); M may be 0.
        simulated_success: which of them reached the goal, (M,).
        goal: goals of the episodes in the target, (N, 2).
    """

    method: str
    success: float
    target: Floats
    target_success: Bools
    simulated: Floats
    simulated_success: Bools
    goal: Floats


def trajectories(maze: Maze, panels: Sequence[Panel], tested: str = "in the target") -> Figure:
    """Draw one maze per row: dashed in the simulator, solid where tested; failures end with a cross."""
    columns = min(len(panels), COLUMNS)
    rows = -(-len(panels) // columns)
    across, up = (float(np.ptp(ends)) for ends in _view(maze))
    with style():
        height = (PANEL_INCHES * up / across + 0.3) * rows + 0.35
        figure = Figure(figsize=(max(4.2, PANEL_INCHES * columns), height), layout="constrained")
        for place, panel in enumerate(panels):
            axes = figure.add_subplot(rows, columns, place + 1)
            draw_walls(axes, maze)
            _paths(axes, panel.target, panel.target_success, DEPLOYED, "-")
            _paths(axes, panel.simulated, panel.simulated_success, SIMULATED, "--")
            for x, y in _goals(maze, panel.goal):
                axes.plot(x, y, "*", ms=13, mfc="#FFD23F", mec=INK, mew=0.8, zorder=6)
            title = method_title(panel.method)
            # The number has to find room beside it.
            size = TITLE_POINTS * min(1.0, TITLE_LETTERS / len(title))
            axes.set_title(title, loc="left", fontsize=size)
            axes.set_title(f"{panel.success:.2f}", loc="right", fontweight="normal")
        handles = [
            Line2D([], [], color=SIMULATED, ls="--", label="in its simulator"),
            Line2D([], [], color=DEPLOYED, label=tested),
            Line2D([], [], color=INK, marker="x", ls="", mew=1.8, label="failed here"),
            Line2D([], [], marker="*", ls="", ms=11, mfc="#FFD23F", mec=INK, mew=0.8, label="goal"),
        ]
        ncols = 4 if columns > 2 else 2
        figure.legend(handles=handles, loc="outside lower center", ncols=ncols, columnspacing=1.6)
        return figure


def dynamics_mismatch(time_s: Floats, command: Floats, simulated: Floats, target: Floats) -> Figure:
    """Draw what the same commands do in the simulator and in the target, over time.

    Args:
        time_s: at the end of each step, (T,).
        command: the velocities commanded, ±1 per axis, (T, 2).
        simulated: x, y, vx, vy in m and m/s, (T, 4).
        target: the same for each repetition in the target, (N, T, 4); NaN after an episode's end.
    """
    alive = np.isfinite(target).all(axis=-1).any(axis=0)
    with style():
        figure = Figure(figsize=(7.6, 4.3), layout="constrained")
        grid = figure.subplots(2, 2, sharex=True)
        for axes, label, one, many in (
            (grid[0, 0], "x (m)", simulated[:, 0], target[..., 0]),
            (grid[0, 1], "y (m)", simulated[:, 1], target[..., 1]),
            (grid[1, 0], "speed (m/s)", _speed(simulated), _speed(target)),
        ):
            for low, high, alpha in ((5, 95, 0.18), (25, 75, 0.32)):
                band = np.nanpercentile(many[:, alive], [low, high], axis=0)
                axes.fill_between(time_s[alive], *band, color=DEPLOYED, alpha=alpha, lw=0)
            axes.plot(time_s[alive], np.nanmean(many[:, alive], axis=0), color=DEPLOYED)
            axes.plot(time_s, one, color=SIMULATED)
            axes.set_ylabel(label)
        for part, dashes in ((0, "-"), (1, ":")):
            grid[1, 1].step(time_s, command[:, part], dashes, where="pre", color=INK, lw=1.2)
        grid[1, 1].set_ylabel("command (±1 per axis)")
        figure.align_ylabels(grid)
        for axes in grid[1]:
            axes.set_xlabel("time (s)")
            axes.set_xlim(0, time_s[-1])
        handles = [
            Line2D([], [], color=SIMULATED, label="simulator"),
            Line2D([], [], color=DEPLOYED, label="target, mean"),
            Patch(fc=DEPLOYED, alpha=0.44, label="25 to 75 %"),
            Patch(fc=DEPLOYED, alpha=0.18, label="5 to 95 %"),
            Line2D([], [], color=INK, lw=1.2, label="command, x"),
            Line2D([], [], color=INK, lw=1.2, ls=":", label="command, y"),
        ]
        figure.legend(
            handles=handles, loc="outside upper center", ncols=6, columnspacing=1.2, handlelength=1.6
        )
        return figure


def _speed(states: Floats) -> Floats:
    return np.asarray(np.hypot(states[..., 2], states[..., 3]))


def _view(maze: Maze) -> tuple[Floats, Floats]:
    """Return (left, right) and (bottom, top) in m: the free cells and a rim of the walls around them."""
    centers = maze.free_centers()
    reach = (0.5 + RIM) * maze.scale
    low, high = centers.min(axis=0) - reach, centers.max(axis=0) + reach
    return np.array([low[0], high[0]]), np.array([low[1], high[1]])


def _goals(maze: Maze, goals: Floats) -> list[Floats]:
    """Return the mean of the `goals` (N, 2) in each cell: goals scatter around its center."""
    cells = np.floor((goals + maze.half_extent) / maze.scale)
    return [goals[(cells == cell).all(axis=1)].mean(axis=0) for cell in np.unique(cells, axis=0)]


def draw_walls(axes: Axes, maze: Maze) -> None:
    """Draw the walls of a maze, and show no more than it."""
    corner = maze.scale / 2
    cells = []
    for row, column in maze.wall_cells():
        x, y = maze.cell_center(row, column)
        cells.append(Rectangle((x - corner, y - corner), maze.scale, maze.scale))
    # The thin edge in the wall's own color closes the hairlines between neighboring cells.
    axes.add_collection(PatchCollection(cells, fc=WALL, ec=WALL, lw=0.5, zorder=1))
    (left, right), (bottom, top) = _view(maze)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _paths(axes: Axes, positions: Floats, success: Bools, color: str, dashes: str) -> None:
    for path, reached in zip(positions, success, strict=True):
        points = path[np.isfinite(path).all(axis=-1)]
        if not len(points):
            continue
        axes.plot(points[:, 0], points[:, 1], dashes, color=color, lw=1.0, alpha=0.7, zorder=3)
        if points.shape[1] > 2:
            axes.plot(points[:, 2], points[:, 3], ":", color=color, lw=1.4, alpha=0.9, zorder=3)
            axes.plot(*points[-1, 2:], "o", color="white", mec=color, ms=4, mew=1.0, zorder=5)
        if not reached:
            axes.plot(*points[-1, :2], "x", color="white", ms=7, mew=3.4, zorder=5)
            axes.plot(*points[-1, :2], "x", color=color, ms=6, mew=1.8, zorder=5)
    starts = positions[:, 0] if len(positions) else np.empty((0, 2))
    axes.plot(starts[:, 0], starts[:, 1], "o", color=FAINT, ms=2.5, mew=0, zorder=4)
