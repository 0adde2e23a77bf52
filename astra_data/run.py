"""Run recipes: every stage for every row and seed, each artefact once, from where the last run stopped."""

import json
import os
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from astra_data.cluster import execute_on_cluster
from astra_data.cores import cores
from astra_data.display import display
from astra_data.errors import BadInputError, MissingStageError, RecipeError
from astra_data.experiment import METHOD_TABLES, STAGES, WHOLE, Part, Recipe
from astra_data.lock import held
from astra_data.plan import plan, select, stage_of
from astra_data.recipe import did_you_mean, load_recipe
from astra_data.rows import base_method
from astra_data.schedule import Item, Watcher, execute

RUNS = Path("runs")
ALWAYS_NEW = {"report"}
"""Made anew by every run: it is cheap, and shows whichever rows and seeds the recipe has now."""
PHYSICS = {"collect", "evaluate"}
"""Stages that step the target's physics, on any number of threads."""
CUDA_JOBS = 2
"""Items at a time on a CUDA device: each process holds a context of its own there."""


def run(
    recipe_path: Path,
    *,
    seeds: Sequence[int] = (),
    root: Path = RUNS,
    jobs: int | None = None,
    device: str = "cpu",
    until: str | None = None,
) -> Path:
    """Make every artefact of a recipe that is not finished yet; return the recipe's folder.

    Args:
        recipe_path: the recipe.
        seeds: those of the recipe's seeds to make and to report; by default all.
        root: where the recipe's folder is.
        jobs: number of items at a time; by default one per core, or `CUDA_JOBS` on a CUDA device.
        device: torch device of the networks.
        until: the last stage to run; by default all.

    Raises:
        RecipeError: the recipe has faults, or differs from the one that made what is there.
        BadInputError: another process runs in the recipe's folder.
        AstraDataError: an item failed.
    """
    _check_stage(until or "report")
    recipe, folder = load_recipe(recipe_path, Recipe), root / recipe_path.stem
    wanted = list(STAGES)[: list(STAGES).index(until or "report") + 1]
    planned = plan(recipe, recipe_path, folder, Part.of(recipe, seeds=seeds), device=device)
    items = [item for item in planned if stage_of(item) in wanted]
    make(recipe, folder, items, jobs=jobs, device=device)
    return folder


def run_stage(
    recipe_path: Path,
    stage: str,
    *,
    method: str | None = None,
    seeds: Sequence[int] = (),
    root: Path = RUNS,
    jobs: int | None = None,
    device: str = "cpu",
    publish: bool = False,
) -> Path:
    """Make the artefacts of one stage of a recipe, of one `method` and of some `seeds` only where given.

    Raises:
        MissingStageError: an artefact that the stage reads is not finished.
        RecipeError: the recipe has faults, or differs from the one that made what is there.
        BadInputError: another process runs in the recipe's folder.
        AstraDataError: an item failed.
    """
    _check_stage(stage)
    recipe, folder = load_recipe(recipe_path, Recipe), root / recipe_path.stem
    part = Part.of(recipe, seeds=seeds)
    planned = plan(recipe, recipe_path, folder, part, device=device, publish=publish)
    items = _selected(recipe, planned, stage, method)
    reads = [key for item in items if not finished(item, folder) for key in item.inputs]
    missing = next((key for key in reads if not (folder / key).is_dir()), None)
    if missing:
        option = "" if root == RUNS else f" --root {root}"
        command = f"astra-data {missing.partition('/')[0]} {recipe_path}{option}"
        raise MissingStageError(f"{folder / missing} is missing: run `{command}` first")
    make(recipe, folder, items, jobs=jobs, device=device)
    return folder / stage


def check(recipe_path: Path, *, root: Path = RUNS) -> dict[str, bool]:
    """Validate a recipe without running it; return each planned artefact and whether it is finished."""
    recipe, folder = load_recipe(recipe_path, Recipe), root / recipe_path.stem
    _check_unchanged(recipe, folder)
    return {item.key: finished(item, folder) for item in plan(recipe, recipe_path, folder)}


Show = Callable[[int, Console], AbstractContextManager[Watcher]]
"""Begins to show so many items, as `display.display` does."""


def make(
    recipe: Recipe,
    folder: Path,
    items: Collection[Item],
    *,
    jobs: int | None,
    device: str,
    cluster: str | None = None,
    show: Show = display,
) -> None:
    """Make those of a recipe's `items` that are not finished yet.

    Args:
        recipe: whose artefacts they are.
        folder: the recipe's.
        items: each after those it reads.
        jobs: number of items at a time; by default one per core, or `CUDA_JOBS` on a CUDA device.
        device: torch device of the networks.
        cluster: address of the Ray cluster that works, or "local" for one that is started; by default
            processes of this machine do.
        show: shows how the items get on.

    Raises:
        RecipeError: the recipe differs from the one that made what is there.
        BadInputError: another process runs in the recipe's folder, or device or cluster are not there.
        AstraDataError: an item failed.
    """
    _check_device(device, cluster)
    folder.mkdir(parents=True, exist_ok=True)
    with held(folder) as ours:
        if not ours:
            raise BadInputError(f"{folder} is in use by another run: wait until it ends, or stop it")
        _check_unchanged(recipe, folder)
        partial_file = folder / ".recipe.json.partial"
        partial_file.write_text(recipe.model_dump_json(indent=2) + "\n")
        os.replace(partial_file, folder / "recipe.json")
        items = [item for item in items if not finished(item, folder)]
        # The networks get one thread: faster as small as they are, and idle threads slow down other items.
        prepare, logs = partial(torch.set_num_threads, 1), folder / "logs"
        with show(len(items), Console()) as watch:
            if cluster is None:
                jobs = jobs or _default_jobs(device)
                execute(_share_cores(items, jobs), jobs=jobs, logs=logs, watch=watch, prepare=prepare)
            else:
                items = [_with_threads(item, 1) for item in items]
                execute_on_cluster(items, address=cluster, jobs=jobs, logs=logs, watch=watch, prepare=prepare)


def _default_jobs(device: str) -> int:
    return CUDA_JOBS if torch.device(device).type == "cuda" else cores()


def _share_cores(items: Collection[Item], jobs: int) -> list[Item]:
    """Tell the items that step the target's physics their share of the cores."""
    counts = Counter(map(stage_of, items))
    return [_with_threads(item, max(1, cores() // min(jobs, counts[stage_of(item)]))) for item in items]


def _with_threads(item: Item, num_threads: int) -> Item:
    if stage_of(item) not in PHYSICS:
        return item
    return replace(item, call=partial(item.call, num_threads=num_threads))


def finished(item: Item, folder: Path) -> bool:
    """Tell whether the artefact of `item` is there, and is not to be made anew."""
    return stage_of(item) not in ALWAYS_NEW and (folder / item.key).is_dir()


def _selected(recipe: Recipe, items: tuple[Item, ...], stage: str, method: str | None) -> list[Item]:
    if method is not None and method not in recipe.methods:
        raise BadInputError(f"the recipe has no method '{method}'{did_you_mean(method, recipe.methods)}")
    if method is not None and stage in ("ground", "align"):
        method = base_method(method)
    selected = list(select(items, stage, method=method))
    if not selected:
        raise BadInputError(f"{method or 'no method of the recipe'} has no stage '{stage}'")
    return selected


def _check_stage(stage: str) -> None:
    if stage not in STAGES:
        raise BadInputError(f"unknown stage '{stage}'{did_you_mean(stage, STAGES)}")


def _check_device(device: str, cluster: str | None) -> None:
    try:
        wanted = torch.device(device)
    except RuntimeError:
        raise BadInputError(f"expected a device such as cpu, cuda or cuda:1, got '{device}'") from None
    if cluster is not None:
        # Ray gives each task its own GPU, which is the only one that it sees.
        if wanted.index:
            raise BadInputError(f"expected device cpu or cuda on a cluster, got '{device}'")
        return
    count = torch.cuda.device_count()
    if wanted.type == "cuda" and (wanted.index or 0) >= count:
        raise BadInputError(f"device '{device}' is not here: torch sees {count} CUDA devices")


def _check_unchanged(recipe: Recipe, folder: Path) -> None:
    """Refuse settings that differ from those that made what is already there, finished or begun."""
    record = folder / "recipe.json"
    if not record.is_file():
        return
    before, now = _told(json.loads(record.read_text())), _told(json.loads(recipe.model_dump_json()))
    changed = {key for key in now.keys() - {"methods", "seeds"} if before.get(key) != now[key]}
    stale: set[str] = set()
    for stage, reads in STAGES.items():
        sections = {"task", stage, *{"collect": ("sweep",), "train": ("plus",)}.get(stage, ())}
        sections |= {table for table, configures in METHOD_TABLES.items() if configures == stage}
        if changed & sections or stale.intersection(reads):
            stale.add(stage)
    present = [str(folder / stage) for stage in STAGES if stage in stale - ALWAYS_NEW]
    present = [stage for stage in present if Path(stage).exists()]
    if present:
        raise RecipeError(
            f"{' and '.join(sorted(changed))} changed in the recipe since {folder} was made: "
            f"give the recipe another name, or remove {' '.join(present)}"
        )


def _told(settings: dict[str, Any]) -> dict[str, Any]:
    """Say of the sizes only what the artefacts of the others depend on: the largest."""
    percents = settings.get("sweep", {}).get("percent", ())
    return settings | {"sweep": max(percents, default=WHOLE)}
