"""The artefacts that a recipe's rows, seeds and sizes need, each once.

    collect ── (augment) ── pair ──┬── ground ──┬── train ──┬── evaluate ── report
                                   │            └── align ──┘
                                   └── (rows without grounding train on the pairs alone)

A row named `<method>_plus` is `<method>` trained with the recipe's `[plus]` settings; it shares the
grounding and the alignment of `<method>`. Where a recipe sweeps over sizes, collect and pair make the largest
once, `subset` makes each size of it, and everything from ground on is made for each.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pydantic import JsonValue

from astra_data.core.config import Config
from astra_data.core.naming import base_method, is_plus, place, reference_of
from astra_data.dataset.edit import share
from astra_data.experiments.execution import Item
from astra_data.experiments.points import Part
from astra_data.experiments.recipe import METHOD_TABLES, WHOLE, Recipe
from astra_data.methods import METHODS
from astra_data.stages.align import align
from astra_data.stages.augment import AugmentConfig, augment
from astra_data.stages.collect import collect
from astra_data.stages.evaluate import evaluate
from astra_data.stages.ground import ground
from astra_data.stages.pair import pair
from astra_data.stages.report import report
from astra_data.stages.subset import subset
from astra_data.stages.train import train


@dataclass(frozen=True)
class Reported:
    """What the report is about, in few words that travel to another process."""

    name: str
    task: str
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    groundings: Mapping[str, str]
    settings: Mapping[str, JsonValue]
    percents: tuple[int, ...] = ()


def plan(
    recipe: Recipe,
    path: Path,
    folder: Path,
    part: Part | None = None,
    *,
    device: str = "cpu",
    publish: Path | None = None,
    add_to: Path | None = None,
) -> tuple[Item, ...]:
    """Return every artefact of `recipe`, each after those it reads, seed after seed.

    Args:
        recipe: what to make.
        path: the recipe's file.
        folder: where it is made, such as `runs/antmaze_long`; an item's artefact is at `folder / key`.
        part: what to make and to report of it; by default all.
        device: torch device of the networks.
        publish: a folder that the report copies its results to, if any.
        add_to: a file of results that the report adds to, if any.
    """
    part = part or Part.of(recipe)
    bases = tuple(dict.fromkeys(base_method(row) for row in part.methods))
    reference = reference_of(recipe.methods)
    grounded = [base for base in (*bases, *([reference] if reference else [])) if METHODS[base].grounds]
    groundings = tuple(dict.fromkeys(map(grounded_as, grounded)))
    rows = [row for row in part.methods if METHODS[base_method(row)].trains]
    initial = [METHODS[base].initial for base in bases]
    trained = tuple(dict.fromkeys([base for base in initial if base] + rows))
    aligned = [base for base in groundings if METHODS[base].aligns]
    items: list[Item] = []
    for seed in part.seeds:
        items.append(_collect(recipe, folder, seed))
        if recipe.augment is not None:
            items.append(_augment(recipe, recipe.augment, folder, seed))
        items.append(_pair(recipe, folder, seed))
        items += (_subset(recipe, folder, seed, percent) for percent in part.percents)
        for percent in part.percents or (None,):
            data = _Data(recipe, folder, seed, percent, device)
            items += (_ground(data, base) for base in groundings)
            items += (_train(data, row) for row in trained)
            items += (_align(data, base) for base in aligned)
            items += (_evaluate(data, row) for row in part.methods)
    return (*items, _report(recipe, path, folder, part, publish, add_to))


def stage_of(item: Item) -> str:
    """Return the stage that makes `item`."""
    return item.key.partition("/")[0]


@dataclass(frozen=True)
class _Data:
    """A dataset that rows are made of: of one seed, whole or one size of it; and what is common to them."""

    recipe: Recipe
    folder: Path
    seed: int
    percent: int | None
    device: str

    @property
    def key(self) -> str:
        return f"{'pair' if self.percent is None else 'subset'}/{place(self.seed, self.percent)}"

    def made(self, stage: str, method: str) -> str:
        """Return the key of what `stage` makes of this dataset for a method or row."""
        return f"{stage}/{method}/{place(self.seed, self.percent)}"

    def read(self, stage: str, method: str | None) -> str | None:
        """Return the same where there is such a method."""
        return self.made(stage, method) if method else None

    def at(self, key: str | None) -> Path | None:
        return self.folder / key if key else None


def _collect(recipe: Recipe, folder: Path, seed: int) -> Item:
    key = f"collect/{place(seed)}"
    config = recipe.collect
    if recipe.largest != WHOLE:
        config = config.model_copy(update={"episodes": share(recipe.largest, config.episodes)})
    call = partial(collect, recipe.task, config, seed=seed, out=folder / key)
    return Item(key, (), call, is_threaded=True)


def _augment(recipe: Recipe, config: AugmentConfig, folder: Path, seed: int) -> Item:
    key, dataset = f"augment/{place(seed)}", f"collect/{place(seed)}"
    call = partial(augment, recipe.task, config, dataset=folder / dataset, seed=seed, out=folder / key)
    return Item(key, (dataset,), call)


def _pair(recipe: Recipe, folder: Path, seed: int) -> Item:
    made = "collect" if recipe.augment is None else "augment"
    key, dataset = f"pair/{place(seed)}", f"{made}/{place(seed)}"
    call = partial(pair, recipe.task, recipe.pair, dataset=folder / dataset, out=folder / key)
    return Item(key, (dataset,), call)


def _subset(recipe: Recipe, folder: Path, seed: int, percent: int) -> Item:
    key, dataset = f"subset/{place(seed, percent)}", f"pair/{place(seed)}"
    whole = recipe.collect.episodes
    return Item(
        key, (dataset,), partial(subset, folder / dataset, percent=percent, of=whole, out=folder / key)
    )


def _ground(data: _Data, base: str) -> Item:
    key = data.made("ground", base)
    call = partial(
        ground,
        data.recipe.task,
        base,
        data.recipe.ground,
        settings=_settings(data.recipe, base, "ground"),
        dataset=data.folder / data.key,
        seed=data.seed,
        out=data.folder / key,
        device=data.device,
    )
    return Item(key, (data.key,), call, device=data.device)


def _train(data: _Data, row: str) -> Item:
    key, base = data.made("train", row), base_method(row)
    grounding, initial = data.read("ground", _grounding(base)), data.read("train", METHODS[base].initial)
    call = partial(
        train,
        data.recipe.task,
        row,
        data.recipe.plus if is_plus(row) else data.recipe.train,
        settings=_settings(data.recipe, base, "train"),
        dataset=data.folder / data.key,
        grounding=data.at(grounding),
        initial=data.at(initial),
        seed=data.seed,
        out=data.folder / key,
        device=data.device,
    )
    inputs = _existing(data.key, grounding, initial)
    return Item(key, inputs, call, is_threaded=METHODS[base].steps_target, device=data.device)


def _align(data: _Data, base: str) -> Item:
    key, grounding = data.made("align", base), data.made("ground", base)
    call = partial(
        align,
        data.recipe.align,
        dataset=data.folder / data.key,
        grounding=data.folder / grounding,
        seed=data.seed,
        out=data.folder / key,
        device=data.device,
    )
    return Item(key, (data.key, grounding), call, device=data.device)


def _evaluate(data: _Data, row: str) -> Item:
    key, base = data.made("evaluate", row), base_method(row)
    policy = data.read("train", row if METHODS[base].trains else None)
    grounding = data.read("ground", _grounding(base))
    reference = data.read("ground", _grounding(reference_of(data.recipe.methods) or base))
    target_encoder = data.read("align", grounded_as(base) if METHODS[base].aligns else None)
    call = partial(
        evaluate,
        data.recipe.task,
        row,
        data.recipe.evaluate,
        policy=data.at(policy),
        grounding=data.at(grounding),
        target_encoder=data.at(target_encoder),
        reference=data.at(reference),
        seed=data.seed,
        out=data.folder / key,
    )
    inputs = _existing(policy, grounding, target_encoder, reference)
    return Item(key, inputs, call, is_threaded=True)


def _report(
    recipe: Recipe, path: Path, folder: Path, part: Part, publish: Path | None, add_to: Path | None
) -> Item:
    groundings = {row: grounded_as(base_method(row)) for row in part.methods}
    reported = Reported(
        path.stem, recipe.task, part.methods, part.seeds, groundings, recipe.settings, part.percents
    )
    call = partial(
        report,
        reported,
        root=folder,
        command=_command(recipe, path, part),
        publish=publish,
        add_to=add_to,
        config=recipe.report,
    )
    return Item("report", tuple(point.key for point in part.points()), call)


def _command(recipe: Recipe, path: Path, part: Part) -> str:
    """Return the command that makes `part`."""
    whole = Part.of(recipe)
    options = [f" --method {row}" for row in part.methods if part.methods != whole.methods]
    options += [f" --seed {seed}" for seed in part.seeds if part.seeds != whole.seeds]
    options += [f" --percent {percent}" for percent in part.percents if part.percents != whole.percents]
    swept = recipe.sweep.percent or part.methods != whole.methods
    return f"astra-data {'sweep' if swept else 'run'} {path}{''.join(options)}"


def _grounding(base: str) -> str | None:
    return grounded_as(base) if METHODS[base].grounds else None


def grounded_as(base: str) -> str:
    """Return the method whose grounding and alignment a method uses."""
    return METHODS[base].grounded_as or base


def _settings(recipe: Recipe, base: str, stage: str) -> Config | None:
    """Return the recipe's table for a method, where it has one for `stage`."""
    table = METHODS[base].table or base
    return recipe.settings_of(table) if METHOD_TABLES.get(table) == stage else None


def _existing(*keys: str | None) -> tuple[str, ...]:
    return tuple(dict.fromkeys(key for key in keys if key is not None))
