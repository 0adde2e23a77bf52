"""Run recipes: make every artifact that is not finished yet; `sweep.csv` has a line per finished evaluation."""

import csv
import json
import logging
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from io import StringIO
from itertools import count
from pathlib import Path
from typing import Any

from rich.console import Console

from astra_data.core.config import did_you_mean
from astra_data.core.durable import alone_in, clean, folder_for, make_folder, move, write_file
from astra_data.core.errors import BadInputError, MissingStageError
from astra_data.core.lazy import torch
from astra_data.core.naming import CODE, RECORD, RUNS, artifact_key, reference_of, row_of_key, stage_of_key
from astra_data.grounding.diagnosis import diagnose
from astra_data.methods import grounded_as, method_named
from astra_data.pipeline.display import display, shown
from astra_data.pipeline.executors import EXECUTORS, Item
from astra_data.pipeline.experiment import (
    ALWAYS_NEW,
    MADE_WITH,
    Condition,
    Experiment,
    condition,
    data_condition,
    load_experiment,
    to_make_again,
)
from astra_data.pipeline.plan import check_stage, plan, selected, stages_until
from astra_data.pipeline.recipe import UserMethod, add_all, check_unchanged, digests_of
from astra_data.pipeline.shipped import is_shipped
from astra_data.pipeline.stages.registry import STAGES
from astra_data.reports.artifacts import CURVE, EVALUATION, METRICS, Artifact, Evaluation, read_json
from astra_data.reports.diagnosis import DIAGNOSIS, diagnosis_page
from astra_data.reports.held_out import write_held_out
from astra_data.reports.results import WHOLE
from astra_data.reports.runs import Owner, Selection, recorded_code
from astra_data.robots.registry import TASKS, task_named
from astra_data.worlds.walk_through import check_task

SET_ASIDE = "set_aside"  # the folder of a run for artifacts that are made again: what took hours to make is not deleted
POINTS = "sweep.csv"
TIMED = {"ground": METRICS, "train": CURVE, "align": METRICS, "evaluate": EVALUATION}
"""Stages that are run for few points at once, and the file with the time that they took."""

_log = logging.getLogger(__name__)


def run(
    recipe_path: Path,
    *,
    methods: Sequence[str] = (),
    seeds: Sequence[int] = (),
    percents: Sequence[int] = (),
    root: Path = RUNS,
    jobs: int | None = None,
    device: str = "cpu",
    until: str | None = None,
    engine: str = "processes",
    address: str | None = None,
) -> Path:
    """Make every artifact of a recipe that is not finished yet; return the recipe's folder, which is in `root`.

    Of its rows, seeds and sizes, those given are made, by default all, up to the stage `until`. There are `jobs`
    items at a time, by default one per core, or two on a CUDA device, run by an `engine` in `EXECUTORS`, Ray's at an
    `address`. Where it grounds, the page of held-out errors is written, too; where it ends with that or with the
    pairs, what they say before any fit.

    Raises:
        RecipeError: the recipe has faults, or differs from the one that made the existing artifacts.
        MissingStageError: an artifact of the recipe that it is based on is not finished.
        BadInputError: the recipe has no such row, seed or size, a package is not installed, or another
            process runs in the recipe's folder.
        AstraDataError: an item failed.

    Example:
        >>> from pathlib import Path
        >>> from astra_data import run
        >>> run(Path("small.toml"), jobs=1, until="pair")
        collect/seed_0  started
        ...
        PosixPath('runs/small')
    """
    stages = stages_until(until)
    experiment = load_experiment(recipe_path, root)
    wanted = stages - experiment.borrowed
    part = selected(experiment.recipe, methods, seeds, percents)
    planned = plan(experiment.recipe, recipe_path, experiment.folder, part, device=device)
    items = [item for item in planned if item.stage in wanted]
    make(experiment, items, planned, part, jobs=jobs, device=device, engine=engine, address=address)
    if "ground" in wanted:
        rows, task = [*part.methods, reference_of(experiment.recipe.methods)], task_named(experiment.recipe.task)
        groundings = dict.fromkeys(grounded_as(row) for row in rows if row and method_named(row).grounds)
        of = replace(part, methods=tuple(groundings))
        write_held_out(recipe_path.stem, experiment.folder, of, timestep_s=task.timestep_s)
    if until in ("pair", "ground"):
        write_diagnosis(experiment, part)
    return experiment.folder


def write_diagnosis(experiment: Experiment, part: Selection) -> None:
    """Write the page of what the paired episodes of the first seed say before any fit, if there are any."""
    recipe, paired = experiment.recipe, experiment.folder / artifact_key("pair", "", part.seeds[0])
    if paired.is_dir():
        try:
            with shown("diagnosis") as progress:
                found = diagnose(paired, recipe.task, progress)
        except BadInputError as error:  # no reason to fail: the pairs are made
            (experiment.folder / DIAGNOSIS).unlink(missing_ok=True)  # of other pairs
            _log.warning("%s is not written: %s", DIAGNOSIS, error)
            return
        page = diagnosis_page(experiment.path.stem, found, task_named(recipe.task).timestep_s)
        write_file(experiment.folder / DIAGNOSIS, page)


def run_stage(
    recipe_path: Path,
    stage: str,
    *,
    methods: Sequence[str] = (),
    seeds: Sequence[int] = (),
    root: Path = RUNS,
    jobs: int | None = None,
    device: str = "cpu",
    publish: bool = False,
) -> Path:
    """Make the artifacts of one stage of a recipe, as `run` does; what it reads is finished.

    With `publish`, the results of the report are added to the published ones.
    """
    check_stage(stage)
    experiment = load_experiment(recipe_path, root)
    maker = experiment.maker(stage)
    if maker is not experiment:
        uses = f"{recipe_path} uses the {stage} of {maker.path}"
        raise BadInputError(f"{uses}: run `astra-data {stage} {maker.path}` instead")
    recipe, folder = experiment.recipe, experiment.folder
    if stage == "collect" and recipe.data is not None:
        raise BadInputError(f"{recipe_path} uses the data {recipe.data}: there is nothing to collect")
    part, results = selected(recipe, methods, seeds), experiment.results if publish else None
    published = experiment.published() if publish else ()
    planned = plan(recipe, recipe_path, folder, part, device=device, reports=part, publish=results, published=published)
    make(experiment, _selected(planned, stage, methods), planned, part, jobs=jobs, device=device)
    return folder / stage


def check(recipe_path: Path, *, root: Path = RUNS, verify: bool = False) -> dict[str, Condition]:
    """Validate a recipe without running it; return each planned artifact and its condition.

    With `verify`, every byte of the artifacts is read; otherwise their sizes are compared.
    """
    experiment = load_experiment(recipe_path, root)
    if not is_shipped(experiment.recipe.task):
        _check_task(experiment)
    recorded_code(experiment.folder)  # refused where it is damaged
    data = data_condition(experiment)
    found = {key: condition(item, experiment, verify=verify) for key, item in experiment.items.items()}
    return found if data is None else {"data": data, **found}


def _check_task(experiment: Experiment, device: str = "cpu") -> None:
    """Refuse a task of the user's own that has faults on a device; list them all."""
    name = experiment.recipe.task
    if name not in TASKS and (faults := check_task(task_named(name), device)):
        raise BadInputError("\n".join(f"{experiment.path}: task {name}: {fault}" for fault in faults))


def check_device(device: str, engine: str = "processes", address: str | None = None) -> None:
    """Check that the CPU or a CUDA device is available to an engine, or may be on its cluster."""
    if engine not in EXECUTORS:
        raise BadInputError(f"unknown engine '{engine}'{did_you_mean(engine, EXECUTORS)}")
    if address is not None and engine != "ray":
        raise BadInputError("--address is for --engine ray: leave it out, or add that")
    if not (wanted := re.fullmatch(r"cpu|cuda(:(\d+))?", device)):
        raise BadInputError(f"expected a device such as cpu, cuda or cuda:1, got '{device}'")
    index = int(wanted[2] or 0)
    if engine == "ray" and index:  # Ray gives each task its own GPU, which is the only one that it sees
        raise BadInputError(f"expected device cpu or cuda on a cluster, got '{device}'")
    if engine != "ray" and device != "cpu" and index >= (found := torch.cuda.device_count()):
        raise BadInputError(f"device '{device}' is not available: torch finds {found} CUDA devices")


def make(
    experiment: Experiment,
    items: Collection[Item],
    planned: Collection[Item],
    part: Selection,
    *,
    jobs: int | None = None,
    device: str = "cpu",
    engine: str = "processes",
    address: str | None = None,
) -> None:
    """Make those of an experiment's `items` that are not finished yet, damaged or stale.

    What is made again is set aside. The `items` stand after those they read, which are among `planned`. Points of
    `part` that finish are shown, and written with all others.
    """
    asked, points = items, part.points()
    check_device(device, engine, address)
    recipe, folder = experiment.recipe, experiment.folder
    with folder_for(folder / RECORD), alone_in(folder):
        experiment.check_unchanged()
        _check_task(experiment, "cpu" if engine == "ray" else device)
        clean(folder)
        again = to_make_again(items, experiment)
        for key in again:  # a robot's logs, say
            if STAGES[stage_of_key(key)].makes_dataset and not (folder / MADE_WITH / f"{key}.json").is_file():
                advice = "restore it from a copy, recover its intact episodes with `astra-data repair`, or remove it"
                raise BadInputError(f"{folder / key} is {again[key]}, and was not made by this recipe: {advice}")
        items = [one for one in items if one.key in again or one.stage in ALWAYS_NEW or not experiment.has(one.key)]
        data = data_condition(experiment) if any(item.stage == "label" for item in items) else None
        _check_inputs(experiment, items, planned)
        experiment.link_borrowed()
        console = Console()
        show = partial(console.print, markup=False, highlight=False, soft_wrap=True)
        for warning in data.warnings if data else ():
            show(f"warning: data: {warning}")
        for key, reason in again.items():
            show(f"{key} is recreated: {reason}; the old one is in {set_aside(folder, key)}")
        write_file(folder / RECORD, recipe.model_dump_json(indent=2) + "\n")
        if digests := digests_of(recipe.task, recipe.user_methods):
            write_file(folder / CODE, json.dumps(recorded_code(folder) | digests, indent=1) + "\n")
        for item in items:
            if item.stage not in ALWAYS_NEW:
                write_file(folder / MADE_WITH / f"{item.key}.json", json.dumps(item.settings, indent=1) + "\n")
        if any(item.stage in ("evaluate", "report") for item in asked):
            _write_points(experiment)

        def finished(key: str) -> None:
            if key in points:
                lines, headline = _write_points(experiment), task_named(recipe.task).objective.scores[0]
                done = f"{len(points.keys() & lines)} of {len(points)} points"
                show(f"{key}  done {headline.text(lines[key][headline.measure])}  ({done})")

        prepare = partial(_prepare, recipe.task, dict(recipe.user_methods), folder)
        with display([item.key for item in items], console, finished) as watch:
            EXECUTORS[engine](items, jobs=jobs, logs=folder / "logs", watch=watch, prepare=prepare, address=address)
    made = {item.key for item in items}
    # What was missing may be another now, such as a policy that was removed and is trained on another machine.
    if any(made.intersection(one.inputs) for one in asked if one.key not in made) and to_make_again(asked, experiment):
        make(experiment, asked, planned, part, jobs=jobs, device=device, engine=engine, address=address)


def _prepare(task: str, user_methods: dict[str, UserMethod], folder: Path) -> None:
    """Make a process ready for an item of a recipe with this task and these methods, in a run's folder."""
    torch.set_num_threads(1)  # one for the networks: they are small, and idle threads would slow down other items
    add_all(user_methods)
    _load(task, tuple((name, own.method) for name, own in user_methods.items()), folder)


@cache
def _load(task: str, methods: tuple[tuple[str, str], ...], folder: Path) -> None:
    """Load the code of a run once in a process; refuse it if it was edited after the run had begun."""
    task_named(task)
    for name, place in (("task", task), *methods):
        check_unchanged(place, folder, name=name)


def _check_inputs(experiment: Experiment, items: Collection[Item], planned: Collection[Item]) -> None:
    """Check that every input of `items` is made by one of them, or finished, intact and not stale."""
    made, known = {item.key for item in items}, {item.key: item for item in planned}
    # The report uses the seeds that are finished, and itself lists rows without any.
    reads = [key for item in items for key in item.inputs if item.stage not in ALWAYS_NEW or experiment.has(key)]
    for key in dict.fromkeys(key for key in reads if key not in made):
        stage, root = stage_of_key(key), experiment.folder.parent
        # The values of datasets are compared whenever they are read.
        found = condition(known[key], experiment, verify=not STAGES[stage].makes_dataset)
        if found.state == "finished":
            continue
        fault = f"{found.state} ({found.why})" if found.why else found.state
        maker = experiment.maker(stage)
        # Of the base, `run` makes what comes before the stage as well; two commands take no recipe.
        alone = stage == "collect" or (maker is experiment and stage not in ("augment", "label"))
        command = f"astra-data {stage if alone else 'run'} {maker.path}"
        option = "" if root == RUNS else f" --root {root}"
        raise MissingStageError(f"{experiment.place(key)} is {fault}: run `{command}{option}` first")


def set_aside(folder: Path, key: str) -> Path:
    """Move the artifact `key` out of the way; return where it is now."""
    places = (folder / SET_ASIDE / str(number) / key for number in count(1))
    aside = next(place for place in places if not place.exists())
    make_folder(aside.parent)
    move(folder / key, aside)
    return aside


def _selected(items: tuple[Item, ...], stage: str, methods: Sequence[str]) -> list[Item]:
    selected = [item for item in items if item.stage == stage]
    if not selected and not methods:
        raise BadInputError(f"the recipe has no stage '{stage}'")
    made = {row_of_key(item.key) for item in selected}
    rows = [grounded_as(row) for row in methods] if stage in ("ground", "align") else methods
    if missing := [row for row in rows if row not in made]:
        raise BadInputError(f"{missing[0]} has no stage '{stage}'")
    return [item for item in selected if not rows or row_of_key(item.key) in rows]


def _write_points(experiment: Experiment) -> dict[str, dict[str, Any]]:
    """Write the lines of all points that are finished now, if there are any, to `sweep.csv`, and return them."""
    points = selected(experiment.recipe).points().items()
    finished = {key: point for key, point in points if (experiment.folder / key / EVALUATION).is_file()}
    lines = {key: _line(experiment, key, point) for key, point in finished.items()}
    if lines:
        text = StringIO()
        writer = csv.DictWriter(text, [*next(iter(lines.values()))], lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines.values())
        write_file(experiment.folder / POINTS, text.getvalue())
    return lines


def _line(experiment: Experiment, key: str, point: Owner) -> dict[str, Any]:
    evaluation = read_json(Evaluation, experiment.folder / key / EVALUATION)
    means, simulated = evaluation.outcomes.means(), evaluation.simulated
    stages = {made: stage_of_key(made) for made in sorted(set(_needed(key, experiment.items)))}
    timed = [experiment.folder / made / TIMED[stage] for made, stage in stages.items() if stage in TIMED]
    # The artifacts that a point was made of may have been deleted since.
    is_complete = all(file.is_file() for file in timed)
    seconds = [read_json(Artifact, file).wall_seconds or 0.0 for file in timed] if is_complete else []
    return {
        "method": point.row,
        "percent": WHOLE if point.percent is None else point.percent,
        "seed": point.seed,
        **{measure: means[measure] for measure in ("success", "steps", "return", "failed")},
        "simulated_success": None if simulated is None else simulated.means()["success"],
        "dataset_version": evaluation.dataset_version,
        "dataset_hash": evaluation.dataset_hash,
        "commit": evaluation.git_commit,
        "wall_seconds": round(sum(seconds), 3) if is_complete else None,
    }


def _needed(key: str, items: Mapping[str, Item]) -> Iterator[str]:
    """Yield `key` and the keys of all artifacts that it is made of; simulators that only test it are not."""
    yield key
    for read in items[key].inputs:
        if not (key.startswith("evaluate/") and read.startswith("ground/")):
            yield from _needed(read, items)
