"""Suggest which episodes to record next, from the groundings of a run that is there."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.artifact import finished_folder
from astra_data.core.config import Config, validated
from astra_data.core.digest import file_digest
from astra_data.core.errors import BadInputError
from astra_data.core.naming import RUNS, artifact_key, reference_of
from astra_data.core.progress import Progress, part, silent
from astra_data.experiments.experiment import load_experiment
from astra_data.experiments.own_methods import add_all
from astra_data.experiments.trained_policy import settings_of
from astra_data.grounding.committee import Committee
from astra_data.grounding.files import GROUNDING, load_grounding
from astra_data.methods import grounded_as, method_named
from astra_data.reports.suggestion import maps_of, suggestion_page
from astra_data.training.proposals import SuggestConfig, Suggestion, suggested
from astra_data.worlds.registry import task_named
from astra_data.worlds.task import Task

FOLDER = "suggest"
PLAN = "plan.json"


class Asked(Config):
    """What a suggestion is made of, and with which settings; `config.json` beside it."""

    task: str
    row: str
    """Row whose groundings are used."""
    groundings: tuple[str, ...]
    """Paths of the groundings in the run."""
    seed: int
    """Random seed of the proposals."""
    suggest: SuggestConfig


def suggest(
    run: str | Path,
    *,
    row: str | None = None,
    seed: int = 0,
    out: Path | None = None,
    root: Path = RUNS,
    progress: Progress = silent,
    **settings: Any,  # noqa: ANN401 - of SuggestConfig
) -> tuple[Path, Suggestion, str]:
    """Suggest episodes by the disagreement of a run's groundings; write plan, map and page.

    All groundings of a row at its largest size are asked, of every seed, with all their members and heads.

    Args:
        run: the folder of a run, or a recipe.
        row: whose groundings; by default the reference, NAS, or else the first that grounds.
        seed: of the proposals.
        out: the folder to write; by default `suggest` in the run's folder, where an older one is replaced.
        root: folder of all runs, in which a recipe's is.
        progress: called with the share done and a note.
        settings: of `SuggestConfig`; by default as the recipe collects.

    Raises:
        BadInputError: it is no run, it has no such groundings, they do not disagree, or `out` is there.

    Returns:
        the folder, the suggestion, and the task as commands name it.
    """
    folder = load_experiment(Path(run), root).folder if str(run).endswith(".toml") else Path(run)
    recipe = settings_of(folder)
    add_all(recipe.get("own_methods", {}))
    base = _grounding_row(row, tuple(recipe["methods"]))
    places = _places(folder, recipe, base)
    task = task_named(recipe["task"])
    asked = Asked(
        task=recipe["task"],
        row=base,
        groundings=tuple(places),
        seed=seed,
        suggest=validated(_usual(task, recipe) | settings, SuggestConfig, "suggest"),
    )
    target = out or folder / FOLDER
    try:
        committee = Committee.of(task, [load_grounding(folder / one / GROUNDING) for one in places])
    except BadInputError as error:
        raise BadInputError(f"{folder}: ground/{base}: {error}") from None
    made_from = {one: file_digest(folder / one / GROUNDING) for one in places}
    settings_text = asked.model_dump_json(indent=1)
    with finished_folder(target, replace=out is None, config=settings_text, made_from=made_from) as made:
        found = suggested(task, committee, asked.suggest, seed=seed, progress=part(progress, 0.0, 0.95))
        _write(made, task, found, asked)
    progress(1.0, f"{len(found.taken)} episodes")
    return target, found, asked.task


def _grounding_row(row: str | None, rows: tuple[str, ...]) -> str:
    """Return the method whose groundings are asked.

    Raises:
        BadInputError: it grounds nothing, or no row does.
    """
    usual = [reference_of(rows), *(one for one in rows if method_named(one).grounds)]
    asked = row or next(filter(None, usual), None)
    if asked is None or not method_named(asked).grounds:
        raise BadInputError(
            f"expected a row that grounds its simulator, such as nas, got {asked or ', '.join(rows)}"
        )
    return grounded_as(asked)


def _places(folder: Path, recipe: dict[str, Any], base: str) -> list[str]:
    """Return the places of the finished groundings of a method at the largest size, seed by seed."""
    percent = max(recipe.get("sweep", {}).get("percent", ()), default=None)
    places = [artifact_key("ground", base, seed, percent) for seed in recipe["seeds"]]
    if found := [one for one in places if (folder / one / GROUNDING).is_file()]:
        return found
    raise BadInputError(
        f"{folder}: expected groundings, {folder / places[0]} and the like: run the recipe until ground first"
    )


def _usual(task: Task, recipe: dict[str, Any]) -> dict[str, Any]:
    """Return the settings by which the recipe collects; without `[collect]`, those that fit the task."""
    if collect := recipe.get("collect"):
        return {key: collect[key] for key in ("max_steps", "start", "hold_s")}
    return {"max_steps": task.objective.horizon, "start": "task" if task.plane is None else "anywhere"}


def _write(folder: Path, task: Task, found: Suggestion, asked: Asked) -> None:
    from astra_data.reports.figures import information_map, png  # noqa: PLC0415 - matplotlib is slow to import

    maps = maps_of(task, found)
    states = found.rollouts.state[:, found.taken].transpose(0, 1).double().numpy()
    gone = found.rollouts.reached[:, found.taken].T.numpy() == 0.0
    states[gone] = np.nan
    figure = information_map(maps, found.plan.starts, states, task.objective.layout)
    (folder / PLAN).write_text(found.plan.model_dump_json(indent=1) + "\n")
    (folder / "map.json").write_text(json.dumps(maps, indent=1) + "\n")
    (folder / "map.png").write_bytes(png(figure))
    page = suggestion_page(task, found, maps, named=asked.task, origin=asked.groundings)
    (folder / "suggest.md").write_text(page)
