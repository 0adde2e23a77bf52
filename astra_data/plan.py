"""What a recipe asks for: its model, and the artefacts that its rows and seeds need.

    collect ── pair ──┬── ground ──┬── train ──┬── evaluate ── report
                      │            └── align ──┘
                      └── (rows without grounding train on the pairs alone)

A row named `<method>_plus` is `<method>` trained with the recipe's `[plus]` settings; it shares the
grounding and the alignment of `<method>`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from astra_data.errors import BadInputError
from astra_data.fitting import GroundConfig
from astra_data.learners.iql import IqlConfig
from astra_data.learners.rma import RmaConfig
from astra_data.methods import METHODS
from astra_data.methods.compass import CompassConfig
from astra_data.methods.nas_golemo import GolemoConfig
from astra_data.recipe import Config, did_you_mean
from astra_data.rows import PLUS, base_method, is_plus, reference_of
from astra_data.schedule import Item
from astra_data.stages.align import AlignConfig, align
from astra_data.stages.collect import CollectConfig, collect
from astra_data.stages.evaluate import EvaluateConfig, evaluate
from astra_data.stages.ground import ground
from astra_data.stages.pair import PairConfig, pair
from astra_data.stages.report import ReportConfig, report
from astra_data.stages.train import train
from astra_data.target_training import TargetConfig
from astra_data.tasks import TASKS
from astra_data.training import TrainConfig
from astra_data.variation import Variation

STAGES: dict[str, tuple[str, ...]] = {
    "collect": (),
    "pair": ("collect",),
    "ground": ("pair",),
    "train": ("pair", "ground"),
    "align": ("pair", "ground"),
    "evaluate": ("train", "ground", "align"),
    "report": ("evaluate",),
}
"""Each stage, in order, and the stages whose artefacts it reads."""

METHOD_TABLES = {
    "domain_randomization": "train",
    "compass": "ground",
    "compass_uniform": "train",
    "rma": "train",
    "nas_golemo": "ground",
    "iql": "train",
    "direct_transfer_iql": "train",
    "target": "train",
}
"""Methods with settings of their own in a recipe, and the stage that they are for."""


class Recipe(Config):
    """One experiment: which methods, on which task, with which seeds and settings."""

    task: str
    """A name in `astra_data.tasks.TASKS`."""
    methods: tuple[str, ...] = Field(min_length=1)
    """Rows of the results: a name in `astra_data.methods.METHODS`, by itself or followed by `_plus`."""
    seeds: tuple[int, ...] = Field(min_length=1)
    """Each seed repeats everything, from the collected dataset on."""
    collect: CollectConfig
    pair: PairConfig
    ground: GroundConfig
    train: TrainConfig
    align: AlignConfig
    evaluate: EvaluateConfig
    report: ReportConfig
    based_on: str | None = None
    """The recipe that all that is not said here, and every artefact it leaves unchanged, is taken from."""
    plus: TrainConfig
    """The training of `_plus` rows: the recipe's `[plus]` table laid over `[train]`."""
    domain_randomization: Variation = Variation(action_noise=(0.05, 0.05), action_scale=(-0.1, 0.1))
    """What domain randomization varies; by default as the paper prints it for navigation."""
    nas_golemo: GolemoConfig = GolemoConfig()
    """How the residual model of Golemo et al. is fitted."""
    rma: RmaConfig = RmaConfig()
    """How the student of rapid motor adaptation learns."""
    target: TargetConfig = TargetConfig()
    """The training of `target` and `full_obs`, laid over `[train]`."""
    compass: CompassConfig = CompassConfig()
    """The ranges of `compass` and `compass_uniform`, and how the former identifies its parameters."""
    iql: IqlConfig = IqlConfig()
    """How IQL learns."""
    direct_transfer_iql: IqlConfig = IqlConfig(learning_rate=1e-4, policy_updates=100)
    """How direct transfer is fine-tuned; by default gently, for it unlearns more than it learns."""

    @property
    def compass_uniform(self) -> Variation:
        """What `compass_uniform` varies."""
        return self.compass.variation

    @model_validator(mode="before")
    @classmethod
    def _add_empty_sections(cls, tables: dict[str, Any]) -> dict[str, Any]:
        return {stage: {} for stage in (*STAGES, "plus")} | tables

    @field_validator("plus", mode="before")
    @classmethod
    def _lay_over_train(cls, overrides: Any, info: ValidationInfo) -> Any:  # noqa: ANN401 - checked next
        train = info.data.get("train")
        return train.model_dump() | overrides if train and isinstance(overrides, dict) else overrides

    @field_validator("task")
    @classmethod
    def _is_known_task(cls, task: str) -> str:
        if task not in TASKS:
            raise ValueError(f"unknown task '{task}'{did_you_mean(task, TASKS)}")
        return task

    @field_validator("methods")
    @classmethod
    def _are_known_methods(cls, rows: tuple[str, ...]) -> tuple[str, ...]:
        for row in rows:
            if base_method(row) not in METHODS:
                raise ValueError(f"unknown method '{row}'{did_you_mean(base_method(row), METHODS)}")
            if is_plus(row) and not METHODS[base_method(row)].in_simulator:
                raise ValueError(
                    f"'{row}' trains nothing in a simulator, so the [plus] settings are without effect: "
                    f"leave out {PLUS}"
                )
        return rows

    @model_validator(mode="after")
    def _has_no_repeats(self) -> Self:
        for name, values in (("methods", self.methods), ("seeds", self.seeds)):
            if len(set(values)) < len(values):
                raise ValueError(f"expected each of {name} once, got {list(values)}")
        return self


@dataclass(frozen=True)
class Reported:
    """What the report is about, in few words that travel to another process."""

    name: str
    task: str
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    groundings: Mapping[str, str]


def plan(
    recipe: Recipe,
    path: Path,
    folder: Path,
    *,
    seeds: Sequence[int] = (),
    device: str = "cpu",
    publish: bool = False,
) -> tuple[Item, ...]:
    """Return every artefact of `recipe`, each after those it reads.

    Args:
        recipe: what to make.
        path: the recipe's file.
        folder: where it is made, such as `runs/antmaze_long`; an item's artefact is at `folder / key`.
        seeds: those of the recipe's seeds to make and to report; by default all.
        device: torch device of the networks.
        publish: whether the report copies its results into `results/` beside the recipe.

    Raises:
        BadInputError: the recipe has no such seed.
    """
    unknown = next((seed for seed in seeds if seed not in recipe.seeds), None)
    if unknown is not None:
        known = ", ".join(map(str, recipe.seeds))
        raise BadInputError(f"the recipe has no seed {unknown}; its seeds: {known}")
    asked = tuple(dict.fromkeys(seeds)) or recipe.seeds
    bases = tuple(dict.fromkeys(base_method(row) for row in recipe.methods))
    groundings = tuple(dict.fromkeys(_grounded_as(base) for base in bases if METHODS[base].grounds))
    trained = [row for row in recipe.methods if METHODS[base_method(row)].trains]
    initial = [METHODS[base].initial for base in bases]
    trained += [base for base in dict.fromkeys(initial) if base and base not in trained]
    items: list[Item] = []
    for seed in asked:
        items.append(_collect(recipe, folder, seed))
        items.append(_pair(recipe, folder, seed))
        items += (_ground(recipe, folder, base, seed, device) for base in groundings)
        items += (_train(recipe, folder, row, seed, device) for row in trained)
        aligned = [base for base in groundings if METHODS[base].aligns]
        items += (_align(recipe, folder, base, seed, device) for base in aligned)
        items += (_evaluate(recipe, folder, row, seed) for row in recipe.methods)
    items.append(_report(recipe, path, folder, asked, publish))
    # Stage by stage, so that work on every seed begins before any seed is finished.
    return tuple(sorted(items, key=lambda item: list(STAGES).index(stage_of(item))))


def stage_of(item: Item) -> str:
    """Return the stage that makes `item`."""
    return item.key.partition("/")[0]


def _collect(recipe: Recipe, folder: Path, seed: int) -> Item:
    key = f"collect/seed_{seed}"
    call = partial(collect, recipe.task, recipe.collect, seed=seed, out=folder / key)
    return Item(key, (), call, is_threaded=True)


def _pair(recipe: Recipe, folder: Path, seed: int) -> Item:
    key, dataset = f"pair/seed_{seed}", f"collect/seed_{seed}"
    call = partial(pair, recipe.task, recipe.pair, dataset=folder / dataset, out=folder / key)
    return Item(key, (dataset,), call)


def _ground(recipe: Recipe, folder: Path, base: str, seed: int, device: str) -> Item:
    key, dataset = f"ground/{base}/seed_{seed}", f"pair/seed_{seed}"
    call = partial(
        ground,
        recipe.task,
        base,
        recipe.ground,
        settings=_settings(recipe, base, "ground"),
        dataset=folder / dataset,
        seed=seed,
        out=folder / key,
        device=device,
    )
    return Item(key, (dataset,), call)


def _train(recipe: Recipe, folder: Path, row: str, seed: int, device: str) -> Item:
    key, dataset = f"train/{row}/seed_{seed}", f"pair/seed_{seed}"
    grounding, base = _grounding(row, seed), base_method(row)
    initial = METHODS[base].initial and f"train/{METHODS[base].initial}/seed_{seed}"
    call = partial(
        train,
        recipe.task,
        row,
        recipe.plus if is_plus(row) else recipe.train,
        settings=_settings(recipe, base, "train"),
        dataset=folder / dataset,
        grounding=folder / grounding if grounding else None,
        initial=folder / initial if initial else None,
        seed=seed,
        out=folder / key,
        device=device,
    )
    inputs = _existing(dataset, grounding, initial)
    return Item(key, inputs, call, is_threaded=METHODS[base].steps_target)


def _align(recipe: Recipe, folder: Path, base: str, seed: int, device: str) -> Item:
    key, dataset, grounding = f"align/{base}/seed_{seed}", f"pair/seed_{seed}", f"ground/{base}/seed_{seed}"
    call = partial(
        align,
        recipe.align,
        dataset=folder / dataset,
        grounding=folder / grounding,
        seed=seed,
        out=folder / key,
        device=device,
    )
    return Item(key, (dataset, grounding), call)


def _evaluate(recipe: Recipe, folder: Path, row: str, seed: int) -> Item:
    key, base = f"evaluate/{row}/seed_{seed}", base_method(row)
    policy = f"train/{row}/seed_{seed}" if METHODS[base].trains else None
    grounding, reference = _grounding(row, seed), _grounding(reference_of(recipe.methods) or row, seed)
    target_encoder = f"align/{_grounded_as(base)}/seed_{seed}" if METHODS[base].aligns else None
    call = partial(
        evaluate,
        recipe.task,
        row,
        recipe.evaluate,
        policy=folder / policy if policy else None,
        grounding=folder / grounding if grounding else None,
        target_encoder=folder / target_encoder if target_encoder else None,
        reference=folder / reference if reference else None,
        seed=seed,
        out=folder / key,
    )
    inputs = _existing(policy, grounding, target_encoder, reference)
    return Item(key, inputs, call, is_threaded=True)


def _report(recipe: Recipe, path: Path, folder: Path, seeds: tuple[int, ...], publish: bool) -> Item:
    inputs = tuple(f"evaluate/{row}/seed_{seed}" for row in recipe.methods for seed in seeds)
    options = "" if seeds == recipe.seeds else "".join(f" --seed {seed}" for seed in seeds)
    groundings = {row: _grounded_as(base_method(row)) for row in recipe.methods}
    call = partial(
        report,
        Reported(path.stem, recipe.task, recipe.methods, seeds, groundings),
        root=folder,
        command=f"astra-data run {path}{options}",
        publish=path.parent / "results" if publish else None,
        config=recipe.report,
    )
    return Item("report", inputs, call)


def _grounding(row: str, seed: int) -> str | None:
    base = base_method(row)
    return f"ground/{_grounded_as(base)}/seed_{seed}" if METHODS[base].grounds else None


def _grounded_as(base: str) -> str:
    return METHODS[base].grounded_as or base


def _settings(recipe: Recipe, base: str, stage: str) -> Config | None:
    """Return the recipe's table for a method, where it has one for `stage`."""
    table = METHODS[base].table or base
    settings: Config | None = getattr(recipe, table) if METHOD_TABLES.get(table) == stage else None
    return settings


def _existing(*keys: str | None) -> tuple[str, ...]:
    return tuple(dict.fromkeys(key for key in keys if key is not None))
