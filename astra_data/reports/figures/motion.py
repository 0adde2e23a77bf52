"""Where policies go: trajectories in the maze, pictures, and identical commands in simulator and target."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from astra_data.core.arrays import Bools, Floats
from astra_data.core.errors import BadInputError
from astra_data.methods import method_title
from astra_data.reports.artifacts import EVALUATION, TRAJECTORIES, Evaluation, read_json, read_tensors
from astra_data.reports.figures.style import DEPLOYED, FAINT, INK, SIMULATED, WALL, Scene, method_color, style
from astra_data.reports.results import Results
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.task import Task

_ROBOTS = 60
_COMMANDS = (((0.8, 0.0), 2.0), ((0.0, 0.8), 1.0), ((-0.8, 0.0), 2.0), ((0.0, -0.8), 1.0), ((0.0, 0.0), 2.0))
"""Velocity (±1 per axis) and its duration in s: a closed loop within one maze cell, then a stop."""


@dataclass(frozen=True)
class CommandReplay:
    """Commands (T, 2), ±1 per axis, and [x, y, vx, vy] after each: simulated (T, 4), of N target robots (N, T, 4)."""

    time_s: Floats
    command: Floats
    simulated: Floats
    target: Floats


def can_replay(task: Task) -> bool:
    """Return whether a task's target can be driven from the start cell by velocities in its plane; not to a ball."""
    planar = task.plane is not None and task.objective.action_size == 2
    return planar and task.ball_index is None and task.make_target is not None


def replay_commands(task: Task) -> CommandReplay:
    """Drive one simulated and 60 target robots from the center of the start cell by the same commands."""
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
    return CommandReplay(
        time_s=np.arange(1, len(command) + 1, dtype=np.float64) * task.timestep_s,
        command=command,
        simulated=torch.stack(simulated).double().numpy(),
        target=torch.stack(target, dim=1).double().numpy(),
    )


COLUMNS, PANEL_INCHES = 4, 2.0  # panels side by side, at most, and the width of one
TITLE_POINTS, TITLE_LETTERS = 10.0, 17  # font size of a panel's title; one of more letters is smaller
TIMES_S = (0.0, 0.5, 1.0, 1.5, 2.0, 4.0, 8.0)
"""Times at which pictures of an episode are taken, in addition to the time limit."""
PICTURE_INCHES = 0.95  # width of such a picture
RIM = 0.35  # visible width of the outer walls, in cells


def trajectories(results: Results, scene: Scene) -> Figure | None:
    """Draw the plane once per method: dashed in the simulator, solid where tested; failures end with a cross."""
    maze = scene.task.maze if scene.task.plane else None
    panels = {row: _walked(folder, scene.episodes) for row, folder in scene.folders(results).items()}
    shown = np.concatenate([path.reshape(-1, 2) for one in panels.values() for path in one.paths] or [np.empty((0, 2))])
    if not np.isfinite(shown).any():
        return None
    view = _view(maze) if maze else _around(shown)
    columns = min(len(panels), COLUMNS)
    rows = -(-len(panels) // columns)
    across, up = (float(np.ptp(ends)) for ends in view)
    with style():
        height = (PANEL_INCHES * up / across + 0.3) * rows + 0.35
        figure = Figure(figsize=(max(4.2, PANEL_INCHES * columns), height), layout="constrained")
        for place, (row, panel) in enumerate(panels.items()):
            axes = figure.add_subplot(rows, columns, place + 1)
            axes.set(xlim=view[0], ylim=view[1], aspect="equal")
            if maze:
                draw_walls(axes, maze)
            else:
                axes.tick_params(labelsize=6)
            panel.draw(axes, maze)
            title = method_title(row)
            # The number has to find room beside it.
            size = TITLE_POINTS * min(1.0, TITLE_LETTERS / len(title))
            axes.set_title(title, loc="left", fontsize=size)
            success = results.summary(row, "success")
            axes.set_title(f"{success.value:.2f}" if success else "", loc="right", fontweight="normal")
        handles = [
            Line2D([], [], color=SIMULATED, ls="--", label="in its simulator"),
            Line2D([], [], color=DEPLOYED, label=results.where),
            Line2D([], [], color=INK, marker="x", ls="", mew=1.8, label="failed here"),
        ]
        if maze:
            handles.append(Line2D([], [], marker="*", ls="", ms=11, mfc="#FFD23F", mec=INK, mew=0.8, label="goal"))
        ncols = 4 if columns > 2 else 2
        figure.legend(handles=handles, loc="outside lower center", ncols=ncols, columnspacing=1.6)
        return figure


@dataclass(frozen=True)
class _Walked:
    """The first N episodes of an evaluation: paths (N, T, 2 K) in m, tested and simulated, and goals (N, G)."""

    tested: Floats
    tested_success: Bools
    simulated: Floats
    simulated_success: Bools
    goal: Floats

    @property
    def paths(self) -> tuple[Floats, Floats]:
        return self.tested, self.simulated

    def draw(self, axes: Axes, maze: Maze | None) -> None:
        _paths(axes, self.tested, self.tested_success, DEPLOYED, "-")
        _paths(axes, self.simulated, self.simulated_success, SIMULATED, "--")
        for x, y in _goals(maze, self.goal) if maze else ():
            axes.plot(x, y, "*", ms=13, mfc="#FFD23F", mec=INK, mew=0.8, zorder=6)


def _walked(folder: Path, episodes: int) -> _Walked:
    evaluation = read_json(Evaluation, folder / EVALUATION)
    tested = f"{evaluation.tested_in}.position"
    tensors = read_tensors(folder / TRAJECTORIES, (tested, "goal"))
    simulated, outcomes = tensors.get("simulated.position"), evaluation.simulated
    if simulated is None or outcomes is None:
        simulated, outcomes = tensors[tested][:0], evaluation.outcomes
    return _Walked(
        tensors[tested][:episodes],
        np.array(evaluation.outcomes.success[:episodes], dtype=bool),
        simulated[:episodes],
        np.array(outcomes.success[: min(episodes, len(simulated))], dtype=bool),
        tensors["goal"][:episodes],
    )


def _around(points: Floats) -> tuple[Floats, Floats]:
    """Return (left, right) and (bottom, top) in m: all points (N, 2), and a tenth of the larger side around them."""
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    rim = max(0.1 * float((high - low).max()), 0.1)
    return np.array([low[0] - rim, high[0] + rim]), np.array([low[1] - rim, high[1] + rim])


def strips(results: Results, scene: Scene) -> Figure | None:
    """Draw the first episode of each method in pictures at the same times; None if nothing can render."""
    task, folders = scene.task, scene.folders(results)
    if task.photograph is None or not folders:
        return None
    longest_s = task.objective.horizon * task.timestep_s
    times_s = [time_s for time_s in TIMES_S if time_s < longest_s] + [longest_s]
    found = {}
    for row, folder in folders.items():
        states = read_tensors(folder / TRAJECTORIES, ("target.state",))["target.state"]
        moments = [round(time_s / task.timestep_s) for time_s in times_s]
        try:
            pictures = task.photograph(states[[moment for moment in moments if moment < len(states)]])
        except BadInputError:
            return None
        failed = bool(read_json(Evaluation, folder / EVALUATION).outcomes.failed[0])
        ended_s = (len(states) - 1) * task.timestep_s
        found[row] = (pictures, f"fell after {ended_s:.1f} s" if failed else f"{ended_s:.0f} s")
    height, width = next(iter(found.values()))[0].shape[1:3]
    with style():
        size = (1.7 + PICTURE_INCHES * len(times_s), 0.3 + PICTURE_INCHES * height / width * len(found))
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(len(found), len(times_s), squeeze=False)
        for line, (row, (pictures, ended)) in zip(grid, found.items(), strict=True):
            for axes in line:
                axes.set_axis_off()
            for axes, picture in zip(line, pictures, strict=False):
                axes.imshow(picture)
            place = {"transform": line[0].transAxes, "ha": "right"}
            name = method_title(row).replace(" + ", " +\n").replace(", ", ",\n")
            line[0].text(-0.08, 0.55, name, va="bottom", weight="bold", color=method_color(row), **place)
            line[0].text(-0.08, 0.5, ended, va="top", color=FAINT, size=8, **place)
        for axes, time_s in zip(grid[0], times_s, strict=True):
            axes.set_title(f"{time_s:g} s", size=8, weight="normal")
        return figure


def mismatch(_: Results, scene: Scene) -> Figure | None:
    """Draw what the same commands do in the simulator and in the target, over time (the paper's Fig. 1)."""
    return dynamics_mismatch(replay_commands(scene.task)) if can_replay(scene.task) else None


def dynamics_mismatch(replay: CommandReplay) -> Figure:
    """Draw a replay of the same commands."""
    time_s, command, simulated, target = replay.time_s, replay.command, replay.simulated, replay.target
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
        figure.legend(handles=handles, loc="outside upper center", ncols=6, columnspacing=1.2, handlelength=1.6)
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
    """Draw the walls of a maze, and no axes."""
    corner = maze.scale / 2
    cells = []
    for row, column in maze.wall_cells():
        x, y = maze.cell_center(row, column)
        cells.append(Rectangle((x - corner, y - corner), maze.scale, maze.scale))
    # The thin edge in the wall's own color closes the hairlines between neighboring cells.
    axes.add_collection(PatchCollection(cells, fc=WALL, ec=WALL, lw=0.5, zorder=1))
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
