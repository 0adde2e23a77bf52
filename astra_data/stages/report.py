"""Report: the results of all rows and seeds of a recipe, as results.json, .md, .html and figures."""

import json
from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field, field_validator

from astra_data.core.artifact import finished_folder
from astra_data.core.config import Config, Share
from astra_data.core.digest import file_digest
from astra_data.core.durable import write_file
from astra_data.core.errors import BadInputError
from astra_data.core.naming import artifact_key
from astra_data.core.progress import Progress, silent
from astra_data.methods import method_named
from astra_data.reports.artifacts import EVALUATION
from astra_data.reports.assembly import assemble
from astra_data.reports.choice import FOLDER, SELECTED
from astra_data.reports.command_replay import can_replay, replay_commands
from astra_data.reports.eval_info import eval_info
from astra_data.reports.files import (
    Found,
    Page,
    check_none_lost,
    publish_results,
    published_figures,
    read_published,
    write_results,
)
from astra_data.reports.held_out import failure_rates, foresight_lines, measured_foresight
from astra_data.reports.html_page import HTML, render_html
from astra_data.reports.page import render
from astra_data.reports.runs import Reported, Runs
from astra_data.reports.schema import Results
from astra_data.reports.sizes import SizeResults, SizesResults, by_size, render_sizes
from astra_data.reports.statistics import REPLICATES
from astra_data.worlds.registry import task_named
from astra_data.worlds.score import SUCCESS
from astra_data.worlds.task import Task

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from astra_data.reports.drawing import Camera


class ReportConfig(Config):
    """Settings of the report."""

    trajectory_methods: tuple[str, ...] = ()
    """Rows whose trajectories are drawn; all rows if none of these is reported."""

    trajectory_episodes: int = Field(default=12, ge=1)
    """Episodes to draw per row and world: the first ones of the row's first seed."""

    paper_success: dict[str, Share] = Field(default_factory=dict)
    """Row → the paper's success rate, shown next to ours."""

    compare: tuple[str, ...] = ("astra",)
    """Methods to compare with every row trained the same way, each with and without [plus]."""

    bootstrap_replicates: int = Field(default=REPLICATES, ge=100)
    """Bootstrap resamples per confidence interval."""

    @field_validator("trajectory_methods", "paper_success", "compare")
    @classmethod
    def _name_known_methods[R: (tuple[str, ...], dict[str, float])](cls, rows: R) -> R:
        try:
            for row in rows:
                method_named(row)
        except BadInputError as error:
            raise ValueError(str(error)) from None
        return rows


def report(
    recipe: Reported,
    *,
    root: Path,
    command: str,
    publish: Path | None = None,
    progress: Progress = silent,
    add_to: Path | None = None,
    config: ReportConfig = ReportConfig(),
) -> None:
    """Write results.json, .md and .html, the figures and eval_info.json to `root`/report.

    Args:
        recipe: names the task, the rows and the seeds.
        root: the recipe's folder of runs.
        command: the command line to print as the results' origin.
        publish: a folder for copies of results.json, .md and the figures, named after the recipe; or None.
        progress: called with the share done and a note.
        add_to: a file of published results to merge with those at `root`, or None.
        config: settings.

    Raises:
        MissingStageError: no row has an evaluation, or one lacks other artifacts for some of its finished
            seeds.
        BadInputError: an artifact is malformed, rows differ in task, episodes, robot or data, or published
            rows or seeds would be lost.
    """
    from astra_data.reports.figures import png, reliability

    for row in (*config.trajectory_methods, *config.paper_success, *config.compare):
        method_named(row)
    read = _read(recipe, root)
    known = {} if add_to is None else by_size(read_published(add_to))
    task = task_named(recipe.task)
    named = replace(recipe, task=task.name)  # not where its file is
    sizes = {
        percent: assemble(
            named,
            root=root,
            command=command,
            replicates=config.bootstrap_replicates,
            scores=task.objective.scores,
            percent=percent,
            paper_success=config.paper_success,
            compare=config.compare,
            published=known.get(percent),
        ).model_copy(update={"stand_in": task.facts.get("stand_in")})
        for percent in _made(recipe, root, known)
    }
    first, last = next(iter(sizes.values())), next(reversed(sizes.values()))
    progress(0.5, f"{len(first.methods)} rows, {len(first.seeds)} seeds")
    sized = {percent: results for percent, results in sizes.items() if percent is not None}
    found: Found
    if recipe.percents:
        found, page, figures = _of_sizes(recipe, sized, task, command, root)
    else:
        found, page, figures = _of_one(first, task, root, config)
    if publish is not None:
        check_none_lost(found, publish)
    images = {name: png(figure) for name, figure in figures.items()}
    progress(0.9, f"{len(images)} figures")
    groundings = dict.fromkeys(grounding for results in sizes.values() for grounding in results.gaps())
    foreseen = measured_foresight(root, [*groundings], recipe.seeds, [*sized])
    rates = failure_rates(foreseen)
    inlined = images | ({"reliability": png(reliability(rates))} if rates else {})
    with finished_folder(root / "report", replace=True, made_from=read) as folder:
        write_results(found, page, images, folder, "results")
        write_file(folder / HTML, render_html(found, inlined, foresight_lines(foreseen)))
        if isinstance(found, Results) and found.headline == SUCCESS:
            write_file(folder / "eval_info.json", json.dumps(eval_info(found), indent=1))
    if publish is not None:
        kept = {} if add_to is None else published_figures(publish, recipe.name)
        publish_results(found, page, kept | images, publish)
    progress(1.0, _headline(last))


def _of_sizes(
    recipe: Reported, sized: Mapping[int, Results], task: Task, command: str, root: Path
) -> tuple[SizesResults, Page, dict[str, "Figure"]]:
    """Return the results of a sweep, how its page is written, and its figures."""
    from astra_data.reports.drawing import figure_of_sizes

    found = SizesResults(
        recipe=recipe.name,
        task=task.name,
        command=command,
        sizes=[SizeResults(percent=percent, results=results) for percent, results in sized.items()],
        unfinished=[percent for percent in recipe.percents if percent not in sized],
    )
    return found, partial(render_sizes, found), {"data_efficiency": figure_of_sizes(found, root)}


def _of_one(
    results: Results, task: Task, root: Path, config: ReportConfig
) -> tuple[Results, Page, dict[str, "Figure"]]:
    """Return the results of one size, how their page is written, and their figures."""
    from astra_data.reports.drawing import figures_of
    from astra_data.reports.figures import dynamics_mismatch

    figures = figures_of(
        results,
        root,
        maze=None if task.plane is None else task.maze,
        camera=_camera(task),
        trajectory_methods=config.trajectory_methods,
        trajectory_episodes=config.trajectory_episodes,
    )
    if can_replay(task):
        replay = replay_commands(task)
        figures["mismatch"] = dynamics_mismatch(
            replay.time_s, replay.command, replay.simulated, replay.target
        )
    return results, partial(render, results), figures


def _read(recipe: Reported, root: Path) -> dict[str, str]:
    """Return the digest of each evaluation that is finished, and of a choice, by its folder in `root`."""
    folders = [
        artifact_key("evaluate", row, seed, percent)
        for row in recipe.methods
        for percent in recipe.percents or (None,)
        for seed in recipe.seeds
    ]
    files = {folder: root / folder / EVALUATION for folder in folders} | {FOLDER: root / FOLDER / SELECTED}
    return {folder: file_digest(file) for folder, file in files.items() if file.exists()}


def _camera(task: Task) -> "Camera | None":
    from astra_data.reports.drawing import Camera

    if task.photograph is None:
        return None
    return Camera(task.photograph, task.timestep_s, task.objective.horizon * task.timestep_s)


def _made(recipe: Reported, root: Path, published: Container[int | None]) -> Sequence[int | None]:
    """Return the dataset sizes with a finished row, here or published; the first without any."""
    percents = recipe.percents or (None,)
    made = [
        percent for percent in percents if percent in published or Runs(recipe, root, percent).any_finished
    ]
    return made or percents[:1]


def _headline(results: Results) -> str:
    score = results.headline
    best = max(results.methods.values(), key=lambda row: row.summary[score.measure].mean)
    return f"best: {best.title}  {score.title} {score.text(best.summary[score.measure].mean)}"
