"""Results → figures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.core.naming import artifact_key
from astra_data.dataset.inspection import Map, visited
from astra_data.dataset.reader import Dataset
from astra_data.reports.artifacts import EVALUATION, TRAJECTORIES, Evaluation, read_json, read_tensors
from astra_data.reports.figures import (
    Curve,
    OpenLoop,
    Panel,
    Scored,
    SimulatorReturns,
    Strip,
    data_efficiency,
    learning_curves,
    open_loop_error,
    predictive_validity,
    score_bars,
    strips,
    trajectories,
)
from astra_data.reports.schema import BandMeans, MethodResults, Results
from astra_data.reports.sizes import SizesResults
from astra_data.reports.tested import where
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.score import SUCCESS, Score

_TIMES_S = (0.0, 0.5, 1.0, 1.5, 2.0, 4.0, 8.0)
"""Times at which pictures of an episode are taken, in addition to the time limit."""


@dataclass(frozen=True)
class Camera:
    """Renders a task's target states.

    Attributes:
        photograph: pictures (K, height, width, 3) of target states (K, S).
        timestep_s: time between two states.
        longest_s: time limit of an episode.
    """

    photograph: Callable[[NDArray[np.float64]], NDArray[np.uint8]]
    timestep_s: float
    longest_s: float


def figures_of(
    results: Results,
    root: Path,
    *,
    maze: Maze | None,
    camera: Camera | None,
    trajectory_methods: Sequence[str],
    trajectory_episodes: int,
) -> dict[str, Figure]:
    """Return the figures of a page by name.

    Args:
        results: all numbers in them.
        root: the recipe's folder of runs; if a row to be drawn has no trajectories there, the figure of
            trajectories is left out.
        maze: the task's; without one the figure of trajectories is left out, too.
        camera: renders the first episodes, if the task has one and this machine can render.
        trajectory_methods: rows whose trajectories are drawn; all rows if none of these is in the results.
        trajectory_episodes: how many of each row.
    """
    figures = {score.measure: _bars(results, score) for score in results.scores}
    drawn = [row for row in trajectory_methods if row in results.methods] or list(results.methods)
    folders = _with_trajectories(root, results, drawn)
    if camera is not None:
        figures |= _pictures(folders, camera)
    if maze is not None and folders:
        panels = [_panel(results, row, folder, trajectory_episodes) for row, folder in folders.items()]
        figures["trajectories"] = trajectories(maze, panels, where(results))
    curves = training_curves(results)
    if curves:
        name = "learning" if results.headline == SUCCESS else f"learning_{results.headline.measure}"
        figures[name] = learning_curves(results.headline, curves)
    gaps = _gaps(results)
    if gaps:
        figures["gap"] = open_loop_error(gaps)
    if results.predictive_validity:
        figures["validity"] = predictive_validity(_simulator_returns(results))
    return figures


def _bars(results: Results, score: Score) -> Figure:
    rows, simulated = results.methods, f"simulated_{score.measure}"
    intervals = {}
    for method, row in rows.items():
        scored = _scored(row, score)
        intervals[method] = (scored.middle, scored.low, scored.high)
    return score_bars(
        score,
        {method: np.array(row.measures()[score.measure]) for method, row in rows.items()},
        intervals,
        {method: row.summary[simulated].mean for method, row in rows.items() if simulated in row.summary},
        where(results),
    )


def _with_trajectories(root: Path, results: Results, rows: Sequence[str]) -> dict[str, Path]:
    """Return row → folder of its first seed with trajectories; empty if any row has none."""
    found = {}
    for row in rows:
        folders = (root / artifact_key("evaluate", row, seed) for seed in results.methods[row].seeds)
        folder = next((folder for folder in folders if (folder / TRAJECTORIES).exists()), None)
        if folder is None:
            return {}
        found[row] = folder
    return found


def _panel(results: Results, row: str, folder: Path, episodes: int) -> Panel:
    evaluation = read_json(Evaluation, folder / EVALUATION)
    tested = f"{evaluation.tested_in}.position"
    tensors = read_tensors(folder / TRAJECTORIES, (tested, "goal"))
    simulated = [] if evaluation.simulated is None else evaluation.simulated.success[:episodes]
    return Panel(
        method=row,
        success=results.methods[row].summary["success"].mean,
        target=tensors[tested][:episodes],
        target_success=np.array(evaluation.outcomes.success[:episodes], dtype=bool),
        simulated=tensors.get("simulated.position", np.empty((0, 1, 2)))[: len(simulated)],
        simulated_success=np.array(simulated, dtype=bool),
        goal=tensors["goal"][:episodes],
    )


def _pictures(folders: Mapping[str, Path], camera: Camera) -> dict[str, Figure]:
    """Return the figure "strips" of the first episode of each row; empty if this machine cannot render."""
    times_s = [time_s for time_s in _TIMES_S if time_s < camera.longest_s] + [camera.longest_s]
    found = {}
    for row, folder in folders.items():
        states = read_tensors(folder / TRAJECTORIES, ("target.state",))["target.state"]
        moments = [round(time_s / camera.timestep_s) for time_s in times_s]
        try:
            pictures = camera.photograph(states[[moment for moment in moments if moment < len(states)]])
        except BadInputError:
            return {}
        failed = bool(read_json(Evaluation, folder / EVALUATION).outcomes.failed[0])
        found[row] = Strip(pictures, (len(states) - 1) * camera.timestep_s, failed)
    return {"strips": strips(times_s, found)} if found else {}


def training_curves(results: Results) -> dict[str, list[Curve]]:
    """Return the trainings of each row whose seeds all have scores."""
    curves = {
        method: [Curve(np.array(seed.steps), np.array(seed.score)) for seed in row.learning]
        for method, row in results.methods.items()
    }
    return {
        method: seeds
        for method, seeds in curves.items()
        if seeds and all(np.isfinite(seed.score).any() for seed in seeds)
    }


def _simulator_returns(results: Results) -> list[SimulatorReturns]:
    return [
        SimulatorReturns(
            title=f"{simulator} simulator".capitalize(),
            returns={
                method: np.array([row.simulator_returns[simulator], row.returns])
                for method, row in results.methods.items()
                if simulator in row.simulator_returns
            },
        )
        for simulator in results.predictive_validity
    ]


def _gaps(results: Results) -> dict[str, OpenLoop]:
    def stack(band: BandMeans) -> Floats:
        return np.array([band.mean, band.low, band.high], dtype=float)

    return {
        name: OpenLoop(
            horizons=np.array(gap.horizons, dtype=float),
            grounded={quantity: stack(band) for quantity, band in gap.grounded.items()},
            raw={quantity: stack(band) for quantity, band in gap.raw.items()},
        )
        for name, gap in results.gaps().items()
    }


def figure_of_sizes(found: SizesResults, root: Path) -> Figure:
    """Draw the headline score over dataset sizes, with coverage maps if a seed has all datasets at `root`."""
    first = found.sizes[0].results
    score = first.headline
    rows = {
        method: {
            size.percent: _scored(row, score)
            for size in found.sizes
            if (row := size.results.methods.get(method))
        }
        for method in found.methods()
    }
    covered: dict[str, list[Map]] = {}
    for folder in _subsets(found, root):
        dataset = Dataset.open(folder)
        for label, role in (("position (m)", "position"), ("velocity (m/s)", "vector")):
            planar = visited(dataset, role)
            if planar is not None:
                covered.setdefault(label, []).append(planar)
    return data_efficiency(
        score,
        [size.percent for size in found.sizes],
        rows,
        covered,
        where(first),
    )


def _scored(row: MethodResults, score: Score) -> Scored:
    of = row.summary[score.measure]
    low, high = (np.nan if end is None else end for end in (of.low, of.high))
    return Scored(np.array(row.measures()[score.measure]), of.iqm, low, high)


def _subsets(found: SizesResults, root: Path) -> list[Path]:
    """Return the datasets of all sizes of the first seed that has all of them; empty without one."""
    for seed in found.sizes[0].results.seeds:
        folders = [root / artifact_key("subset", "", seed, size.percent) for size in found.sizes]
        if all(folder.is_dir() for folder in folders):
            return folders
    return []
