"""Sweeps: a recipe's rows on every seed and size, with a table of the finished points.

A point is finished when its evaluation is. `sweep.csv` in the recipe's folder has one line per finished
point, rewritten from the artifacts whenever one is finished.
"""

import csv
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

from rich.console import Console

from astra_data.core.durable import write_file
from astra_data.core.naming import RUNS, stage_of_key
from astra_data.core.optional import optional
from astra_data.pipeline.display import display
from astra_data.pipeline.executors import Item, Watcher
from astra_data.pipeline.experiment import Experiment, load_experiment
from astra_data.pipeline.held_out import write_errors
from astra_data.pipeline.plan import plan, stage_of, stages_until
from astra_data.pipeline.points import RunPoint, Selection
from astra_data.pipeline.recipe import WHOLE
from astra_data.pipeline.run import make
from astra_data.reports.artifacts import CURVE, EVALUATION, METRICS, Artifact, Evaluation, read_json

TIMED = {"ground": METRICS, "train": CURVE, "align": METRICS, "evaluate": EVALUATION}
"""Stages that are run for few points at once, and the file with the time that they took."""

COLUMNS = (
    *("method", "percent", "seed", "success", "steps", "return", "failed", "simulated_success"),
    *("dataset_version", "dataset_hash", "commit", "wall_seconds"),
)

Log = Callable[[dict[str, Any]], None]
"""Called with the line of each point that is finished."""


def sweep(
    recipe_path: Path,
    *,
    methods: Sequence[str] = (),
    seeds: Sequence[int] = (),
    percents: Sequence[int] = (),
    root: Path = RUNS,
    jobs: int | None = None,
    device: str = "cpu",
    cluster: str | None = None,
    trackio: str | None = None,
    until: str | None = None,
) -> Path:
    """Make every point of a recipe that is not finished yet, and its report; return the recipe's folder.

    Args:
        recipe_path: the recipe.
        methods: rows of the recipe to make and to report; by default all.
        seeds: seeds of the recipe; by default all.
        percents: sizes of the recipe; by default all.
        root: folder with the recipe's folder.
        jobs: number of items at a time; by default one per core, or two on a CUDA device.
        device: torch device of the networks.
        cluster: address of a Ray cluster to work on, or "local" to start one; by default none.
        trackio: project of trackio to which each finished point is logged, if any.
        until: the last stage to run, by default all; after "ground" comes a page of held-out errors.

    Raises:
        RecipeError: the recipe has faults, or differs from the one that made the existing artifacts.
        BadInputError: the recipe has no such row, seed or size, Ray or trackio is not installed, or another
            process runs in the recipe's folder.
        AstraDataError: an item failed.
    """
    stages = stages_until(until)
    experiment = load_experiment(recipe_path, root)
    part = Selection.of(experiment.recipe, methods, seeds, percents)
    log = _tracked(trackio, experiment.folder.name) if trackio else None
    items = plan(experiment.recipe, recipe_path, experiment.folder, part, device=device)
    points = part.points()
    wanted = [item for item in items if stage_of(item) in stages - experiment.borrowed]
    show = partial(_shown, PointTable(experiment, points), log)
    make(experiment, wanted, items, jobs=jobs, device=device, cluster=cluster, show=show)
    if any(stage_of(item) == "ground" for item in wanted):
        write_errors(experiment, part)
    return experiment.folder


class PointTable:
    """The finished points of a recipe, in `sweep.csv`.

    Attributes:
        shown: the selected points.
        means: score of each finished point, the mean over its episodes.
    """

    def __init__(self, experiment: Experiment, points: Collection[RunPoint]) -> None:
        """Look at all points of the recipe; show `points`."""
        recipe, self.experiment, self.folder = experiment.recipe, experiment, experiment.folder
        self.means: dict[RunPoint, float] = {}
        self._headline = recipe.headline
        self._points, self.shown = Selection.of(recipe).points(), tuple(points)
        self._items = {item.key: item for item in plan(recipe, experiment.path, self.folder)}
        self._lines: dict[RunPoint, dict[str, Any]] = {}

    def write(self) -> dict[RunPoint, dict[str, Any]]:
        """Write the lines of all points that are finished now, and return them."""
        for point in self._points:
            # The line of a finished point does not change any more.
            if point not in self._lines and (self.folder / point.key).is_dir():
                self._lines[point] = self._line(point)
        lines = {point: self._lines[point] for point in self._points if point in self._lines}
        self.means = {point: line[self._headline.measure] for point, line in lines.items()}
        text = StringIO()
        writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines.values())
        write_file(self.folder / "sweep.csv", text.getvalue())
        return lines

    def message(self, point: RunPoint) -> str:
        """Return one line for a point that has just finished."""
        score = self._headline.text(self.means[point])
        done = sum(one in self.means for one in self.shown)
        return f"{point.key}  done {score}  ({done} of {len(self.shown)} points)"

    def _line(self, point: RunPoint) -> dict[str, Any]:
        evaluation = read_json(Evaluation, self.folder / point.key / EVALUATION)
        means = evaluation.outcomes.means()
        stages = {key: stage_of_key(key) for key in sorted(set(_needed(point.key, self._items)))}
        timed = [self.folder / key / TIMED[stage] for key, stage in stages.items() if stage in TIMED]
        # The artifacts that a point was made of may have been deleted since.
        is_complete = all(file.is_file() for file in timed)
        seconds = [read_json(Artifact, file).wall_seconds or 0.0 for file in timed] if is_complete else []
        simulated = evaluation.simulated
        return {
            "method": point.method,
            "percent": WHOLE if point.percent is None else point.percent,
            "seed": point.seed,
            "success": means["success"],
            "steps": means["steps"],
            "return": means["return"],
            "failed": means["failed"],
            "simulated_success": None if simulated is None else simulated.means()["success"],
            "dataset_version": evaluation.dataset_version,
            "dataset_hash": evaluation.dataset_hash,
            "commit": evaluation.git_commit,
            "wall_seconds": round(sum(seconds), 3) if is_complete else None,
        }


def _needed(key: str, items: Mapping[str, Item]) -> Iterator[str]:
    """Yield `key` and the keys of all artifacts that it is made of.

    An evaluation is made of the policy and its encoder, not of the simulators in which it tests them.
    """
    yield key
    for read in items[key].inputs:
        if not (key.startswith("evaluate/") and read.startswith("ground/")):
            yield from _needed(read, items)


@contextmanager
def _shown(table: PointTable, log: Log | None, keys: Collection[str], console: Console) -> Iterator[Watcher]:
    """Show the running items, and keep `sweep.csv` up to date."""
    table.write()
    with display(keys, console) as watch:
        yield _PointWatcher(watch, table, log, console)


class _PointWatcher:
    """Passes notifications on, and writes down every point that is finished."""

    def __init__(self, watch: Watcher, table: PointTable, log: Log | None, console: Console) -> None:
        self.started, self.progressed, self.failed = watch.started, watch.progressed, watch.failed
        self._watch, self._table, self._log, self._console = watch, table, log, console

    def finished(self, key: str, seconds: float) -> None:
        self._watch.finished(key, seconds)
        point = next((point for point in self._table.shown if point.key == key), None)
        if point is None:
            return
        line = self._table.write()[point]
        self._console.print(self._table.message(point), markup=False, highlight=False, soft_wrap=True)
        if self._log:
            self._log(line)


def _tracked(project: str, recipe: str) -> Log:
    """Return a function that logs each point as a run of a trackio project."""
    trackio = optional("trackio")

    def log(line: dict[str, Any]) -> None:
        named = {key: line[key] for key in ("method", "percent", "seed")}
        name = f"{recipe} {' '.join(map(str, named.values()))}"
        settings = {key: value for key, value in line.items() if isinstance(value, str)}
        trackio.init(project=project, name=name, config=named | settings)
        trackio.log({key: value for key, value in line.items() if isinstance(value, float)})
        trackio.finish()

    return log
