"""Report: what all rows and seeds of a recipe gave, as results.json, results.md and figures."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydantic import Field

from astra_data.checkpoint import finished_folder
from astra_data.dataset.reader import Dataset
from astra_data.figures import (
    Curve,
    Foretold,
    OpenLoop,
    Panel,
    Visits,
    data_efficiency,
    dynamics_mismatch,
    learning_curves,
    open_loop_error,
    png,
    predictive_validity,
    success_bars,
    trajectories,
)
from astra_data.inspection import visited
from astra_data.mazes import Maze
from astra_data.methods import method_named
from astra_data.mismatch import replay_commands
from astra_data.progress import Progress
from astra_data.recipe import Config, Share
from astra_data.results.artefacts import EVALUATION, TRAJECTORIES, Evaluation, read_json, read_tensors
from astra_data.results.assembly import assemble
from astra_data.results.files import Found, publish_results, write_results
from astra_data.results.model import BandMeans, Results
from astra_data.results.page import render
from astra_data.results.sizes import SizeResults, SizesResults, render_sizes
from astra_data.rows import place
from astra_data.statistics import REPLICATES
from astra_data.tasks import TASKS

Floats = NDArray[np.float64]


class ReportConfig(Config):
    """How a report is drawn."""

    trajectory_methods: tuple[str, ...] = ()
    """Rows whose trajectories are drawn where they are reported; all rows when none of them is."""

    trajectory_episodes: int = Field(default=12, ge=1)
    """Episodes drawn per row and world, the first ones of the row's first seed."""

    paper_success: dict[str, Share] = Field(default_factory=dict)
    """Row → what the paper prints for it, shown beside ours."""

    bootstrap_replicates: int = Field(default=REPLICATES, ge=100)
    """Resamples behind each interval."""


DEFAULTS = ReportConfig()


class Reported(Protocol):
    """What a report needs to know of a recipe."""

    @property
    def name(self) -> str:
        """Name of the recipe's file, without its ending."""

    @property
    def task(self) -> str:
        """Name of a task."""

    @property
    def methods(self) -> Iterable[str]:
        """Rows, in the order of the table."""

    @property
    def seeds(self) -> Iterable[int]:
        """Seeds to report, of each row those that are finished."""

    @property
    def groundings(self) -> Mapping[str, str]:
        """Row → the method whose grounding and alignment it uses, where that is not its own."""

    @property
    def percents(self) -> Sequence[int]:
        """Sizes of the dataset that every row is repeated on; none where it is made on the whole."""


def report(
    recipe: Reported,
    *,
    root: Path,
    command: str,
    publish: Path | None,
    progress: Progress,
    config: ReportConfig = DEFAULTS,
) -> None:
    """Write results.json, results.md and the figures to `root`/report.

    Args:
        recipe: names the task, the rows and the seeds.
        root: the recipe's folder of runs.
        command: the command line to print as the results' origin.
        publish: a folder for copies named after the recipe, or None.
        progress: told the share done and what was written.
        config: how to draw.

    Raises:
        MissingStageError: no row has an evaluation, or one has other artefacts for some of its finished
            seeds only.
        BadInputError: an artefact is malformed, or rows were evaluated differently.
    """
    for row in (*config.trajectory_methods, *config.paper_success):
        method_named(row)
    sizes = _with_common_rows(
        assemble(
            recipe.name,
            recipe.task,
            tuple(recipe.methods),
            tuple(recipe.seeds),
            root=root,
            command=command,
            replicates=config.bootstrap_replicates,
            groundings=recipe.groundings,
            percent=percent,
            paper_success=config.paper_success,
        )
        for percent in recipe.percents or (None,)
    )
    progress(0.5, f"{len(sizes[0].methods)} rows, {len(sizes[0].seeds)} seeds")
    found: Found
    if recipe.percents:
        found = _sizes(recipe, command, sizes)
        page, figures = partial(render_sizes, found), {"data_efficiency": _data_efficiency(found, root)}
    else:
        found, figures = sizes[0], _figures(sizes[0], root, config)
        page = partial(render, found)
    images = {name: png(figure) for name, figure in figures.items()}
    progress(0.9, f"{len(images)} figures")
    with finished_folder(root / "report", replace=True) as folder:
        write_results(found, page, images, folder, "results")
    if publish is not None:
        publish_results(found, page, images, publish)
    progress(1.0, _headline(sizes[-1]))


def _with_common_rows(sizes: Iterable[Results]) -> list[Results]:
    """Leave out the rows that are not finished at every size."""
    found = list(sizes)
    rows = [row for row in found[0].methods if all(row in results.methods for results in found)]
    return [
        results.model_copy(update={"methods": {row: results.methods[row] for row in rows}})
        for results in found
    ]


def _figures(results: Results, root: Path, config: ReportConfig) -> dict[str, Figure]:
    figures = {
        "success": _success(results),
        "trajectories": _trajectories(results, root, TASKS[results.task].maze, config),
    }
    replay = replay_commands(TASKS[results.task])
    figures["mismatch"] = dynamics_mismatch(replay.time_s, replay.command, replay.simulated, replay.target)
    curves = _curves(results)
    if curves:
        figures["learning"] = learning_curves(curves)
    gaps = _gaps(results)
    if gaps:
        figures["gap"] = open_loop_error(gaps)
    if results.predictive_validity:
        figures["validity"] = predictive_validity(_foretold(results))
    return figures


def _success(results: Results) -> Figure:
    rows = results.methods
    intervals = {}
    for method, row in rows.items():
        summary = row.summary["success"]
        low, high = (np.nan if end is None else end for end in (summary.low, summary.high))
        intervals[method] = (summary.iqm, low, high)
    return success_bars(
        {method: np.array(row.success) for method, row in rows.items()},
        intervals,
        {
            method: row.summary["simulated_success"].mean
            for method, row in rows.items()
            if row.simulated_success is not None
        },
    )


def _trajectories(results: Results, root: Path, maze: Maze, config: ReportConfig) -> Figure:
    panels = []
    drawn = [row for row in config.trajectory_methods if row in results.methods]
    for method in drawn or results.methods:
        folder = root / "evaluate" / method / f"seed_{results.methods[method].seeds[0]}"
        evaluation = read_json(Evaluation, folder / EVALUATION)
        tensors = read_tensors(folder / TRAJECTORIES, ("target.position", "goal"))
        count = config.trajectory_episodes
        simulated = [] if evaluation.simulated is None else evaluation.simulated.success[:count]
        panels.append(
            Panel(
                method=method,
                success=results.methods[method].summary["success"].mean,
                target=tensors["target.position"][:count],
                target_success=np.array(evaluation.target.success[:count], dtype=bool),
                simulated=tensors.get("simulated.position", np.empty((0, 1, 2)))[: len(simulated)],
                simulated_success=np.array(simulated, dtype=bool),
                goal=tensors["goal"][:count],
            )
        )
    return trajectories(maze, panels)


def _curves(results: Results) -> dict[str, list[Curve]]:
    curves = {
        method: [Curve(np.array(seed.steps), np.array(seed.success)) for seed in row.learning]
        for method, row in results.methods.items()
    }
    return {
        method: seeds
        for method, seeds in curves.items()
        if seeds and all(np.isfinite(seed.success).any() for seed in seeds)
    }


def _foretold(results: Results) -> list[Foretold]:
    return [
        Foretold(
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
        return np.array([band.mean, band.low, band.high])

    return {
        name: OpenLoop(
            horizons=np.array(gap.horizons, dtype=float),
            grounded={quantity: stack(band) for quantity, band in gap.grounded.items()},
            raw={quantity: stack(band) for quantity, band in gap.raw.items()},
        )
        for name, gap in results.gaps().items()
    }


def _sizes(recipe: Reported, command: str, sizes: Sequence[Results]) -> SizesResults:
    return SizesResults(
        recipe=recipe.name,
        task=recipe.task,
        command=command,
        sizes=[
            SizeResults(percent=percent, results=results)
            for percent, results in zip(recipe.percents, sizes, strict=True)
        ],
    )


def _data_efficiency(found: SizesResults, root: Path) -> Figure:
    first = found.sizes[0].results
    rows = {method: [size.results.methods[method] for size in found.sizes] for method in first.methods}
    summaries = {method: [row.summary["success"] for row in of] for method, of in rows.items()}
    covered: dict[str, list[Visits]] = {}
    for size in found.sizes:
        dataset = Dataset.open(root / "subset" / place(first.seeds[0], size.percent))
        for label, role in (("position (m)", "position"), ("velocity (m/s)", "vector")):
            planar = visited(dataset, role)
            if planar is not None:
                covered.setdefault(label, []).append(Visits(planar.counts, planar.extent))
    return data_efficiency(
        [size.percent for size in found.sizes],
        {method: [np.array(row.success) for row in of] for method, of in rows.items()},
        # Where there is a single seed, None becomes NaN.
        {
            method: np.array([(of.iqm, of.low, of.high) for of in sizes], dtype=np.float64).T
            for method, sizes in summaries.items()
        },
        covered,
    )


def _headline(results: Results) -> str:
    best = max(results.methods.values(), key=lambda row: row.summary["success"].mean)
    return f"best: {best.title}  success {best.summary['success'].mean:.2f}"
