"""Where policies go: trajectories in the maze, and identical commands in simulator and target."""

from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from astra_data.core.arrays import Floats
from astra_data.methods import method_title
from astra_data.reports.artifacts import EVALUATION, TRAJECTORIES, Evaluation, read_json, read_tensors
from astra_data.reports.figures.style import DEPLOYED, FAINT, INK, SIMULATED, WALL, Scene, style
from astra_data.reports.results import Results
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.task import Task

_ROBOTS = 60
_COMMANDS = (((0.8, 0.0), 2.0), ((0.0, 0.8), 1.0), ((-0.8, 0.0), 2.0), ((0.0, -0.8), 1.0), ((0.0, 0.0), 2.0))
"""Velocity (±1 per axis) and its duration in s: a closed loop within one maze cell, then a stop."""


def can_replay(task: Task) -> bool:
    """Return whether a task's target can be driven from the start cell by velocities in its plane; not to a ball."""
    planar = task.plane is not None and task.objective.action_size == 2
    return planar and task.ball_index is None and task.make_target is not None


def replay_commands(task: Task) -> tuple[Floats, Floats, Floats, Floats]:
    """Drive one simulated and 60 target robots from the center of the start cell by the same commands.

    Return times (T,) in s, commands (T, 2), ±1, and [x, y, vx, vy] after each: simulated (T, 4), of targets (N, T, 4).
    """
    command = np.concatenate([np.tile(velocity, (round(seconds * task.fps), 1)) for velocity, seconds in _COMMANDS])
    robots = task.target(_ROBOTS, seed=0)
    robots.reset()
    states = robots.state.double().numpy()
    states[:, :2] = task.maze.cell_center(*task.maze.start)
    robots.reset_to(np.arange(_ROBOTS), states)
    simulator = task.simulator(1)
    simulator.reset_to(task.abstraction(robots.state[:1]))
    simulated, target, fallen = [], [], torch.zeros(_ROBOTS, dtype=torch.bool)
    for velocity in torch.from_numpy(command).float():
        simulated.append(simulator.step(velocity.expand(1, 2))[0])
        robots.step(velocity.expand(_ROBOTS, 2))
        target.append(torch.where(fallen[:, None], torch.nan, task.abstraction(robots.state)))
        fallen |= robots.failed
    time_s = np.arange(1, len(command) + 1, dtype=np.float64) * task.timestep_s
    return time_s, command, torch.stack(simulated).double().numpy(), torch.stack(target, dim=1).double().numpy()


COLUMNS, PANEL_INCHES = 4, 2.0  # panels side by side, at most, and the width of one
TITLE_POINTS, TITLE_LETTERS = 10.0, 17  # font size of a panel's title; one of more letters is smaller
RIM = 0.35  # visible width of the outer walls, in cells


@style()
def trajectories(results: Results, scene: Scene) -> Figure | None:
    """Draw the plane once per method: dashed in the simulator, solid where tested; failures end with a cross."""
    maze = scene.task.plane
    panels = {row: _walked(folder, scene.episodes) for row, folder in scene.folders(results).items()}
    found = [path.reshape(-1, 2) for paths, _ in panels.values() for path, *_ in paths]
    points = np.concatenate([*found, np.empty((0, 2))])
    if not np.isfinite(points).any():
        return None
    points = np.array([maze.cell_center(*cell) for cell in maze.cells(walls=False)]) if maze else points
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    # Part of the outer walls, or a tenth of the larger side.
    rim = (0.5 + RIM) * maze.scale if maze else max(0.1 * float((high - low).max()), 0.1)
    view = np.array([low - rim, high + rim]).T
    columns = min(len(panels), COLUMNS)
    rows = -(-len(panels) // columns)
    across, up = np.ptp(view, axis=1)
    height = (PANEL_INCHES * up / across + 0.3) * rows + 0.35
    figure = Figure(figsize=(max(4.2, PANEL_INCHES * columns), height), layout="constrained")
    for place, (row, (paths, goals)) in enumerate(panels.items(), start=1):
        axes = figure.add_subplot(rows, columns, place)
        axes.set(xlim=view[0], ylim=view[1], aspect="equal")
        if maze:
            draw_walls(axes, maze)
        else:
            axes.tick_params(labelsize=6)
        for path in paths:
            _draw_paths(axes, *path)
        cells = np.floor((goals + maze.half_extent) / maze.scale) if maze else goals[:0]
        for cell in np.unique(cells, axis=0):  # around whose center goals scatter
            x, y = goals[(cells == cell).all(axis=1)].mean(axis=0)
            axes.plot(x, y, "*", ms=13, mfc="#FFD23F", mec=INK, mew=0.8, zorder=6)
        title = method_title(row)  # beside which the number has to find room
        axes.set_title(title, loc="left", fontsize=TITLE_POINTS * min(1.0, TITLE_LETTERS / len(title)))
        success = results.summary(row, "success")
        axes.set_title(f"{success.value:.2f}" if success else "", loc="right", fontweight="normal")
    handles = [
        Line2D([], [], color=SIMULATED, ls="--", label="in its simulator"),
        Line2D([], [], color=DEPLOYED, label=results.where),
        Line2D([], [], color=INK, marker="x", ls="", mew=1.8, label="failed here"),
    ]
    if maze:
        handles.append(Line2D([], [], marker="*", ls="", ms=11, mfc="#FFD23F", mec=INK, mew=0.8, label="goal"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4 if columns > 2 else 2, columnspacing=1.6)
    return figure


def _walked(folder: Path, episodes: int) -> tuple[list[tuple[Floats, list[float], str, str]], Floats]:
    """Return the first N paths (N, T, 2 K) in m, tested and simulated, with success and look; and goals (N, G)."""
    evaluation = read_json(Evaluation, folder / EVALUATION)
    tested = f"{evaluation.tested_in}.position"
    tensors = read_tensors(folder / TRAJECTORIES, (tested, "goal"))
    found = [(tensors[tested][:episodes], evaluation.outcomes.success, DEPLOYED, "-")]
    if evaluation.simulated and "simulated.position" in tensors:
        found.append((tensors["simulated.position"][:episodes], evaluation.simulated.success, SIMULATED, "--"))
    return [one for one in found if one[0].shape[-1]], tensors["goal"][:episodes]  # abstract states may have no place


def mismatch(_: Results, scene: Scene) -> Figure | None:
    """Draw what the same commands do in the simulator and in the target, over time (the paper's Fig. 1)."""
    return dynamics_mismatch(*replay_commands(scene.task)) if can_replay(scene.task) else None


@style()
def dynamics_mismatch(time_s: Floats, command: Floats, simulated: Floats, target: Floats) -> Figure:
    """Draw a replay of the same commands, as `replay_commands` returns it."""
    alive = np.isfinite(target).all(axis=-1).any(axis=0)
    figure = Figure(figsize=(7.6, 4.3), layout="constrained")
    grid = figure.subplots(2, 2, sharex=True)
    for axes, label, part in zip(grid.flat, ("x (m)", "y (m)", "speed (m/s)"), (0, 1, 2), strict=False):
        one, many = (np.hypot(of[..., 2], of[..., 3]) if part == 2 else of[..., part] for of in (simulated, target))
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
    figure.legend(handles=handles, loc="outside upper center", ncols=6, columnspacing=1.2, handlelength=1.6)
    return figure


def draw_walls(axes: Axes, maze: Maze) -> None:
    """Draw the walls of a maze, and no axes."""
    half, centers = maze.scale / 2, [maze.cell_center(*cell) for cell in maze.cells(walls=True)]
    cells = [Rectangle((x - half, y - half), maze.scale, maze.scale) for x, y in centers]
    # The thin edge in the wall's own color closes the hairlines between neighboring cells.
    axes.add_collection(PatchCollection(cells, fc=WALL, ec=WALL, lw=0.5, zorder=1))
    axes.set_axis_off()


def _draw_paths(axes: Axes, positions: Floats, success: list[float], color: str, dashes: str) -> None:
    for path, reached in zip(positions, success, strict=False):
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
