"""Run recipes: make every artifact that is not finished yet, for every row and seed."""

import logging
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager
from functools import partial
from itertools import count
from pathlib import Path

import torch
from rich.console import Console

from astra_data.core.durable import alone_in, clean, folder_for, make_folder, move, write_file
from astra_data.core.errors import BadInputError, MissingStageError
from astra_data.core.naming import RECORD, RUNS, row_of_key, stage_of_key
from astra_data.methods import grounded_as
from astra_data.pipeline.condition import Condition, can_be_made_again, condition, spoilt, to_make_again
from astra_data.pipeline.data_check import data_condition
from astra_data.pipeline.devices import check_device, default_jobs, share_cores, with_threads
from astra_data.pipeline.display import display
from astra_data.pipeline.executors import Item, Watcher, execute, execute_on_cluster
from astra_data.pipeline.experiment import ALWAYS_NEW, Experiment, load_experiment
from astra_data.pipeline.held_out import write_errors
from astra_data.pipeline.plan import check_stage, plan, stage_of, stages_until
from astra_data.pipeline.points import Selection
from astra_data.pipeline.stages.registry import STAGES
from astra_data.pipeline.stages.report import is_current
from astra_data.pipeline.user_code import OwnMethod, add_all, record_code
from astra_data.robots.registry import TASKS, task_named
from astra_data.worlds.walk_through import check_task

SET_ASIDE = "set_aside"
"""The folder of a run for artifacts that are made again: what took hours to make is not deleted."""
_log = logging.getLogger(__name__)


def run(
    recipe_path: Path,
    *,
    seeds: Sequence[int] = (),
    root: Path = RUNS,
    jobs: int | None = None,
    device: str = "cpu",
    until: str | None = None,
) -> Path:
    """Make every artifact of a recipe that is not finished yet; return the recipe's folder.

    Where it grounds, the page of held-out errors is written there.

    Args:
        recipe_path: the recipe.
        seeds: the recipe's seeds to make and to report; by default all.
        root: folder with the recipe's folder.
        jobs: number of items at a time; by default one per core, or two on a CUDA device.
        device: torch device of the networks.
        until: the last stage to run, by default all.

    Raises:
        RecipeError: the recipe has faults, or differs from the one that made the existing artifacts.
        MissingStageError: an artifact of the recipe that it is based on is not finished.
        BadInputError: another process runs in the recipe's folder.
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
    part = Selection.of(experiment.recipe, seeds=seeds)
    planned = plan(experiment.recipe, recipe_path, experiment.folder, part, device=device)
    items = [item for item in planned if stage_of(item) in wanted]
    make(experiment, items, planned, jobs=jobs, device=device)
    if "ground" in wanted:
        write_errors(experiment, part)
    return experiment.folder


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
    """Make the artifacts of one stage of a recipe, of some `methods` and `seeds` only where given.

    With `publish`, the results of the report are added to the published ones.

    Raises:
        MissingStageError: an artifact that the stage reads is not finished.
        RecipeError: the recipe has faults, or differs from the one that made the existing artifacts.
        BadInputError: another process runs in the recipe's folder.
        AstraDataError: an item failed.
    """
    check_stage(stage)
    experiment = load_experiment(recipe_path, root)
    maker = experiment.maker(stage)
    if maker is not experiment:
        raise BadInputError(
            f"{recipe_path} uses the {stage} of {maker.path}: run `astra-data {stage} {maker.path}` instead"
        )
    recipe, folder = experiment.recipe, experiment.folder
    if stage == "collect" and recipe.data is not None:
        raise BadInputError(f"{recipe_path} uses the data {recipe.data}: there is nothing to collect")
    part = Selection.of(recipe, methods, seeds)
    planned = plan(
        recipe,
        recipe_path,
        folder,
        part,
        device=device,
        publish=experiment.results if publish else None,
        published=experiment.published() if publish else (),
    )
    make(experiment, _selected(planned, stage, methods), planned, jobs=jobs, device=device)
    return folder / stage


def check(recipe_path: Path, *, root: Path = RUNS, verify: bool = False) -> dict[str, Condition]:
    """Validate a recipe without running it; return each planned artifact and its condition.

    A task of the user's own is walked through, as by `check_task`. With `verify`, every byte of the artifacts
    is read; otherwise their sizes are compared.

    Raises:
        RecipeError: the recipe has faults.
        BadInputError: its task has faults; lists them all. Or its data are not the task's.
    """
    experiment = load_experiment(recipe_path, root)
    _check_task(experiment)
    data = data_condition(experiment.recipe)
    planned = plan(experiment.recipe, recipe_path, experiment.folder)
    conditions = {item.key: condition(item, experiment, verify=verify) for item in planned}
    return conditions if data is None else {"data": data, **conditions}


def _check_task(experiment: Experiment, device: str = "cpu") -> None:
    """Refuse a task of the user's own that has faults on a device; list them all."""
    name = experiment.recipe.task
    if name not in TASKS and (faults := check_task(task_named(name), device)):
        raise BadInputError("\n".join(f"{experiment.path}: task {name}: {fault}" for fault in faults))


Show = Callable[[Collection[str], Console], AbstractContextManager[Watcher]]
"""Shows the progress of items by their keys, as `display.display` does."""


def make(
    experiment: Experiment,
    items: Collection[Item],
    planned: Collection[Item],
    *,
    jobs: int | None,
    device: str,
    cluster: str | None = None,
    show: Show = display,
) -> None:
    """Make those of an experiment's `items` that are not finished yet, damaged or stale.

    A task of the user's own is walked through before. What is made again is set aside, with a line that says
    why and where.

    Args:
        experiment: whose artifacts they are.
        items: each after those it reads.
        planned: all items of the recipe that these may read.
        jobs: number of items at a time; by default one per core, or two on a CUDA device.
        device: torch device of the networks.
        cluster: address of the Ray cluster to run on, or "local" to start one; by default processes of
            this machine are used.
        show: shows the progress of the items.

    Raises:
        MissingStageError: an artifact that an item reads is neither among them nor finished and intact.
        RecipeError: the recipe differs from the one that made the existing artifacts.
        BadInputError: another process runs in the recipe's folder, the device or cluster is not available, or
            a dataset is damaged that the recipe cannot make again.
        AstraDataError: an item failed.
    """
    check_device(device, cluster)
    recipe, folder = experiment.recipe, experiment.folder
    with folder_for(folder / RECORD), alone_in(folder):
        experiment.check_unchanged()
        _check_task(experiment, "cpu" if cluster else device)
        clean(folder)
        again = to_make_again(items, experiment)
        for key, reason in again.items():
            if not can_be_made_again(key, experiment):
                raise BadInputError(
                    f"{experiment.place(key)} is {reason}, and was not made by this recipe: restore it from "
                    "a copy, recover its intact episodes with `astra-data repair`, or remove it"
                )
        items = [item for item in items if item.key in again or not finished(item, experiment)]
        if [stage_of(item) for item in items] == ["report"] and _is_reported(items[0]):
            items = []
        data = data_condition(recipe) if any(stage_of(item) == "label" for item in items) else None
        _check_inputs(experiment, items, planned)
        experiment.link_borrowed()
        console = Console()
        for warning in data.warnings if data else ():
            console.print(f"warning: data: {warning}", markup=False, highlight=False, soft_wrap=True)
        for key, reason in again.items():
            line = f"{key} is recreated: {reason}; the old one is in {set_aside(folder, key)}"
            console.print(line, markup=False, highlight=False, soft_wrap=True)
        write_file(folder / RECORD, recipe.model_dump_json(indent=2) + "\n")
        record_code(recipe, folder)
        prepare, logs = partial(_prepare, dict(recipe.own_methods)), folder / "logs"
        with show([item.key for item in items], console) as watch:
            if cluster is None:
                jobs = jobs or default_jobs(device)
                execute(share_cores(items, jobs), jobs=jobs, logs=logs, watch=watch, prepare=prepare)
            else:
                items = [with_threads(item, 1) for item in items]
                execute_on_cluster(items, address=cluster, jobs=jobs, logs=logs, watch=watch, prepare=prepare)


def _is_reported(item: Item) -> bool:
    """Return whether the report is there already, made of what it would be made of."""
    call = item.call
    if not isinstance(call, partial) or call.keywords["publish"] is not None:
        return False
    return is_current(*call.args, **call.keywords)


def _prepare(own_methods: dict[str, OwnMethod]) -> None:
    """Make a process ready for an item of a recipe with these methods of its own."""
    # One thread for the networks: they are small, and idle threads would slow down other items.
    torch.set_num_threads(1)
    add_all(own_methods)


def _check_inputs(experiment: Experiment, items: Collection[Item], planned: Collection[Item]) -> None:
    """Check that every input of `items` is made by one of them, or finished, intact and not stale."""
    made, known = {item.key for item in items}, {item.key: item for item in planned}
    # The report uses the seeds that are finished, and itself lists rows without any.
    reads = [
        key
        for item in items
        for key in item.inputs
        if key not in made and (stage_of(item) not in ALWAYS_NEW or experiment.has(key))
    ]
    for key in dict.fromkeys(reads):
        stage, root = stage_of_key(key), experiment.folder.parent
        fault = spoilt(known[key], experiment) if experiment.has(key) else "missing"
        if not fault:
            continue
        maker = experiment.maker(stage)
        # Of the base, `run` makes what comes before the stage as well; two commands take no recipe.
        alone = stage not in ("augment", "label") and (maker is experiment or not STAGES[stage].reads)
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


def finished(item: Item, experiment: Experiment) -> bool:
    """Return whether the artifact of `item` is finished and need not be made again."""
    return stage_of(item) not in ALWAYS_NEW and experiment.has(item.key)


def _selected(items: tuple[Item, ...], stage: str, methods: Sequence[str]) -> list[Item]:
    selected = [item for item in items if stage_of(item) == stage]
    if not selected and not methods:
        raise BadInputError(f"the recipe has no stage '{stage}'")
    made = {row_of_key(item.key) for item in selected}
    rows = [grounded_as(row) for row in methods] if stage in ("ground", "align") else methods
    for row in rows:
        if row not in made:
            raise BadInputError(f"{row} has no stage '{stage}'")
    return [item for item in selected if not rows or row_of_key(item.key) in rows]
