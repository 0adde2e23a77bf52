"""Report: the results of all methods and seeds of a recipe, as results.json, .md, .html and figures."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pydantic import Field, field_validator

from astra_data.core.artifact import finished_folder
from astra_data.core.config import Config, Share, as_fault
from astra_data.core.durable import file_digest, write_file
from astra_data.core.progress import Progress, silent
from astra_data.methods import method_named
from astra_data.reports.artifacts import EVALUATION
from astra_data.reports.blocks import html, markdown
from astra_data.reports.choice import FOLDER, SELECTED
from astra_data.reports.results import merge, read_results, replaced, results_json
from astra_data.reports.runs import Reported, read_run
from astra_data.reports.verdict import verdict_of
from astra_data.robots.registry import task_named

JSON, PAGE, HTML = "results.json", "results.md", "results.html"
_log = logging.getLogger(__name__)


class ReportConfig(Config):
    """Settings of the report."""

    trajectory_methods: tuple[str, ...] = ()
    """Methods whose trajectories are drawn; all if none of these is reported."""
    trajectory_episodes: int = Field(default=12, ge=1)
    """Episodes to draw per method and world: the first ones of its first seed."""
    paper_success: dict[str, Share] = Field(default_factory=dict)
    """Method → the paper's success rate, shown next to ours."""
    compare: tuple[str, ...] = ("astra",)
    """Methods to compare with every method trained the same way, each with and without the plus settings."""

    @field_validator("trajectory_methods", "paper_success", "compare")
    @classmethod
    def _name_known_methods[R: (tuple[str, ...], dict[str, float])](cls, rows: R) -> R:
        with as_fault():
            for row in rows:
                method_named(row)
        return rows


def report(
    recipe: Reported,
    *,
    root: Path,
    command: str,
    publish: Path | None = None,
    published: Sequence[Path] = (),
    progress: Progress = silent,
    config: ReportConfig = ReportConfig(),
) -> None:
    """Write results.json, .md and .html and figures to `root`/report; with `published` ones, to `publish`/<recipe>."""
    from astra_data.reports.figures.catalog import FIGURES, PUBLISHED, drawn
    from astra_data.reports.figures.style import Scene
    from astra_data.reports.page import sections_of

    task = task_named(recipe.task)
    found = read_run(
        replace(recipe, task=task.name),  # not where its file is
        root=root,
        command=command,
        scores=task.objective.scores,
        paper_success={row: value for row, value in config.paper_success.items() if row in recipe.methods},
        compare=config.compare,
        stand_in=task.facts.get("stand_in"),
        timestep_s=task.timestep_s,
    )
    earlier = [read_results(path) for path in published]
    for path, one in zip(published, earlier, strict=True):
        if changed := replaced(one, found):
            _log.warning("%s: new results replace those of %s", path, "; ".join(changed))
    found = merge([*earlier, found]) if earlier else found
    progress(0.5, f"{len(found.tested())} methods, {len(found.seeds)} seeds")
    images = drawn(found, Scene(root, task, config.trajectory_methods, config.trajectory_episodes))
    progress(0.9, f"{len(images)} figures")
    sections = sections_of(found, f"runs/{root.name}" if root.is_absolute() else str(root))  # as commands name it

    def write(folder: Path, images: Mapping[str, bytes]) -> None:
        for name, image in images.items():
            write_file(folder / f"{name}.png", image)
        shown = {name: file for name in FIGURES if (folder / (file := f"{name}.png")).exists()}
        write_file(folder / JSON, results_json(found))
        write_file(folder / PAGE, markdown(found.recipe, sections, shown))

    read = {key: root / key / EVALUATION for key in recipe.points()} | {FOLDER: root / FOLDER / SELECTED}
    made_from = {key: file_digest(file) for key, file in read.items() if file.exists()}
    with finished_folder(root / "report", replace=True, made_from=made_from) as folder:
        write(folder, images)
        write_file(folder / HTML, html(found.recipe, sections, images))
    if publish is not None:
        write(publish / recipe.name, {name: image for name, image in images.items() if name in PUBLISHED})
    progress(1.0, verdict_of(found).text.replace("**", ""))
