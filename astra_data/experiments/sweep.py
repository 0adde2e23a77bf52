"""Sweeps: a recipe's rows on every seed and size, point by point, with a table of what is finished.

A point is finished when its evaluation is. `sweep.csv` in the recipe's folder has one line per finished
point, written anew from the artefacts themselves whenever one is finished.
"""

import csv
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from io import StringIO
from os import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from astra_data.core.errors import BadInputError
from astra_data.core.optional import optional
from astra_data.experiments.board import Board, needed
from astra_data.experiments.display import display
from astra_data.experiments.experiment import Experiment, load_experiment
from astra_data.experiments.local_executor import Item, Watcher
from astra_data.experiments.plan import plan, stage_of
from astra_data.experiments.points import RunPoint, Selection
from astra_data.experiments.recipe import WHOLE
from astra_data.experiments.run import RUNS, finished, make
from astra_data.reports.artefacts import EVALUATION, Artefact, Evaluation, read_json

TIMED = {
    "ground": "metrics.json",
    "train": "curve.json",
    "align": "metrics.json",
    "evaluate": EVALUATION,
}
"""Stages that work for few points, and the file that tells how long they took."""

COLUMNS = (
    *("method", "percent", "seed", "success", "steps", "return", "failed", "simulated_success"),
    *("dataset_version", "dataset_hash", "commit", "wall_seconds"),
)

Log = Callable[[dict[str, Any]], None]
"""Is told the line of each point that is finished."""


def sweep(
    recipe_path: Path,
    *,
    methods: Sequence[str] = (),
    seeds: Sequence[int] = (),
    percents: Sequence[int] = (),
    unpublished: bool = False,
    root: Path = RUNS,
    jobs: int | None = None,
    device: str = "cpu",
    cluster: str | None = None,
    trackio: str | None = None,
) -> Path:
    """Make every point of a recipe that is not finished yet, and its report; return the recipe's folder.

    Args:
        recipe_path: the recipe.
        methods: those of its rows to make and to report; by default all.
        seeds: those of its seeds; by default all.
        percents: those of its sizes; by default all.
        unpublished: leave out the points that its published results have.
        root: where the recipe's folder is.
        jobs: number of items at a time; by default one per core, or two on a CUDA device.
        device: torch device of the networks.
        cluster: address of a Ray cluster to work on, or "local" to start one; by default none.
        trackio: project of trackio to which each finished point is logged, if any.

    Raises:
        RecipeError: the recipe has faults, or differs from the one that made what is there.
        BadInputError: the recipe has no such row, seed or size, none that is not published or no published
            results, Ray or trackio is asked for and missing, or another process runs in the recipe's folder.
        AstraDataError: an item failed.
    """
    experiment = load_experiment(recipe_path, root)
    part = Selection.of(experiment.recipe, methods, seeds, percents)
    log = _tracked(trackio, experiment.folder.name) if trackio else None
    table = Table(experiment)
    items = plan(experiment.recipe, recipe_path, experiment.folder, part, device=device)
    points = part.points()
    if unpublished:
        points, items = _left(points, items, experiment.published())
    wanted = [item for item in items if experiment.maker(stage_of(item)) is experiment]
    show = partial(_shown, table, points, items, log)
    make(experiment, wanted, jobs=jobs, device=device, cluster=cluster, show=show)
    return experiment.folder


def _left(
    points: Sequence[RunPoint], items: Sequence[Item], published: Collection[RunPoint]
) -> tuple[tuple[RunPoint, ...], tuple[Item, ...]]:
    """Return the points that are not published, and what they need, with the report."""
    left = tuple(point for point in points if point not in published)
    if not left:
        raise BadInputError("all of these points are published: leave out --unpublished to make them again")
    inputs = {item.key: item.inputs for item in items}
    needs, to_look_at = {"report"}, [point.key for point in left]
    while to_look_at:
        key = to_look_at.pop()
        if key not in needs:
            needs.add(key)
            to_look_at += inputs[key]
    return left, tuple(item for item in items if item.key in needs)


class Table:
    """The finished points of a recipe, in `sweep.csv`."""

    def __init__(self, experiment: Experiment) -> None:
        """Look at all points of the recipe, whichever are made now."""
        recipe, self.experiment, self.folder = experiment.recipe, experiment, experiment.folder
        self.headline = recipe.headline
        self._points = Selection.of(recipe).points()
        self._items = {item.key: item for item in plan(recipe, experiment.path, self.folder)}
        self._lines: dict[RunPoint, dict[str, Any]] = {}

    def write(self) -> dict[RunPoint, dict[str, Any]]:
        """Write the lines of all points that are finished now, and return them."""
        for point in self._points:
            # What is finished does not change any more.
            if point not in self._lines and (self.folder / point.key).is_dir():
                self._lines[point] = self._line(point)
        lines = {point: self._lines[point] for point in self._points if point in self._lines}
        text = StringIO()
        writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines.values())
        partial_file = self.folder / ".sweep.csv.partial"
        partial_file.write_text(text.getvalue())
        replace(partial_file, self.folder / "sweep.csv")
        return lines

    def _line(self, point: RunPoint) -> dict[str, Any]:
        evaluation = read_json(Evaluation, self.folder / point.key / EVALUATION)
        means = evaluation.target.means()
        stages = {key: key.partition("/")[0] for key in sorted(set(needed(point.key, self._items)))}
        timed = [self.folder / key / TIMED[stage] for key, stage in stages.items() if stage in TIMED]
        # What a point was made of may have been deleted since.
        is_complete = all(file.is_file() for file in timed)
        seconds = [read_json(Artefact, file).wall_seconds or 0.0 for file in timed] if is_complete else []
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


@contextmanager
def _shown(
    table: Table,
    points: Collection[RunPoint],
    items: Collection[Item],
    log: Log | None,
    total: int,
    console: Console,
) -> Iterator[Watcher]:
    """Show the points above the running items, and keep the table."""
    lines = table.write().items()
    means = {point: line[table.headline.measure] for point, line in lines if point in set(points)}
    to_do = [item.key for item in items if not finished(item, table.experiment)]
    board = Board(points, items, table.headline, means, to_do)
    with display(total, console, above=board) as watch:
        yield _PointWatcher(watch, board, {point.key: point for point in points}, table, log, console)


class _PointWatcher:
    """Passes on what it is told, and writes down every point that is finished."""

    def __init__(
        self,
        watch: Watcher,
        board: Board,
        points: dict[str, RunPoint],
        table: Table,
        log: Log | None,
        console: Console,
    ) -> None:
        self._watch, self._board, self._points = watch, board, points
        self._table, self._log, self._console = table, log, console

    def started(self, key: str) -> None:
        self._board.started(key)
        self._watch.started(key)

    def progressed(self, key: str, fraction: float, note: str) -> None:
        self._board.progressed(key, fraction)
        self._watch.progressed(key, fraction, note)

    def finished(self, key: str, seconds: float) -> None:
        self._board.finished(key, seconds)
        self._watch.finished(key, seconds)
        if key in self._points:
            point = self._points[key]
            line = self._table.write()[point]
            self._board.done(point, line[self._table.headline.measure])
            told = f"{key}  {self._board.state(point)}  ({self._board.whole()})"
            self._console.print(told, markup=False, highlight=False, soft_wrap=True)
            if self._log:
                self._log(line)

    def failed(self, key: str) -> None:
        self._board.failed(key)
        self._watch.failed(key)


def _tracked(project: str, recipe: str) -> Log:
    """Return what logs a point as a run of its own to a project of trackio."""
    trackio = optional("trackio", "trackio")

    def log(line: dict[str, Any]) -> None:
        named = {key: line[key] for key in ("method", "percent", "seed")}
        name = f"{recipe} {' '.join(map(str, named.values()))}"
        settings = {key: value for key, value in line.items() if isinstance(value, str)}
        trackio.init(project=project, name=name, config=named | settings)
        trackio.log({key: value for key, value in line.items() if isinstance(value, float)})
        trackio.finish()

    return log
