"""Experiments: a recipe, the folder of its artifacts and their condition, and the recipe that it is based on, if any.

A stage whose artifacts would be the base's is not run again: a link in the recipe's folder leads to them. What an
artifact is made with, its settings and the digests of the user's code, is written to `made_with/<key>.json` before it
is begun. While they are others, what was made or begun with them is refused.
"""

import json
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from astra_data.core.artifact import MANIFEST, read_manifest
from astra_data.core.config import Config, did_you_mean, read_written, validated
from astra_data.core.durable import begun_beside
from astra_data.core.errors import AstraDataError, BadInputError, RecipeError
from astra_data.core.naming import base_method, first_few, shortened, stage_of_key
from astra_data.dataset.columns import ABSTRACT_STATE, ACTION
from astra_data.dataset.description import changed_values, full_name, identity_of, read_description
from astra_data.dataset.edit import share
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import lineage, open_dataset
from astra_data.grounding.paired_episodes import divided
from astra_data.io.hub.stores import is_address
from astra_data.methods import METHODS, grounded_as, method_named
from astra_data.pipeline.executors import Item
from astra_data.pipeline.plan import plan
from astra_data.pipeline.recipe import Recipe, read_tables
from astra_data.pipeline.stages.label import check_fits, remarks
from astra_data.pipeline.stages.registry import STAGES
from astra_data.pipeline.stages.report import JSON
from astra_data.reports.results import Results, read_results
from astra_data.robots.registry import task_named
from astra_data.worlds.commands import Commands

ALWAYS_NEW = {"report"}  # made by every run: it is cheap, and shows the rows and seeds that the recipe has now
MADE_WITH = "made_with"  # the folder of a run for what its artifacts were made with
_MOST_KEYS, _MOST_LETTERS = 3, 60
BEYOND = 0.05  # share of the recorded range by which bounds may be wider without a warning
TIMES = 20  # how many times as wide as the bounds the recorded range may be without a warning


@dataclass(frozen=True)
class Experiment:
    """A recipe, with what it takes from its base, its file, and the folder of its artifacts."""

    recipe: Recipe
    path: Path
    folder: Path
    base: "Experiment | None" = None

    @cached_property
    def items(self) -> dict[str, Item]:
        """All artifacts of the recipe by their keys, each after those it reads."""
        return {item.key: item for item in plan(self.recipe, self.path, self.folder)}

    @cached_property
    def borrowed(self) -> set[str]:
        """The stages whose artifacts are taken from the base: those that would be the same."""
        if self.base is None:
            return set()
        others = set[str]()
        for key, item in self.items.items():
            like = self.base.items.get(key)
            is_same = like and (item.settings, {*item.inputs}) == (like.settings, {*like.inputs})
            if not is_same or others.intersection(item.inputs):
                others.add(key)
        stages = {item.stage for item in self.items.values()}
        return stages - {stage_of_key(key) for key in others} - ALWAYS_NEW

    def maker(self, stage: str) -> "Experiment":
        """Return the experiment that makes the artifacts of `stage`."""
        return self.base if self.base and stage in self.borrowed else self

    def place(self, key: str) -> Path:
        """Return the folder of the artifact `key`."""
        return self.maker(stage_of_key(key)).folder / key

    def has(self, key: str) -> bool:
        """Return whether the artifact `key` is finished."""
        stage = stage_of_key(key)
        return self.place(key).is_dir() and not self.maker(stage)._is_link(stage)

    def _is_link(self, stage: str) -> bool:
        link = self.folder / stage
        return link.is_symlink() and link.readlink().parent.parent == Path("..")

    def link_borrowed(self) -> None:
        """Link the folders of borrowed stages to the base's."""
        for stage in STAGES:
            link, source = self.folder / stage, self.maker(stage).folder.name
            if self._is_link(stage):
                link.unlink()
            if stage in self.borrowed and (link.exists() or link.is_symlink()):
                uses = f"{self.path} is based on {source}, whose {stage} it uses"
                raise RecipeError(f"{link} is in the way: {uses}; give the recipe another name, or remove {link}")
            if stage in self.borrowed:
                link.symlink_to(Path("..") / source / stage)

    @cached_property
    def _outdated(self) -> dict[str, str]:
        """What changed since artifacts were made or begun, by their keys, and those that read them."""
        found: dict[str, str] = {}
        for key, item in self.items.items():
            if item.stage in ALWAYS_NEW | self.borrowed or not self._made(key):
                continue
            changed, file = "", self.folder / MADE_WITH / f"{key}.json"
            if file.is_file():
                advice = f"restore it from a copy, or remove it with {self.folder / key}"
                before = read_written(dict[str, Any], file, by="a run", advice=advice)
                changed = _changes(before, item.settings, self.recipe)
            if changed := changed or next((found[made] for made in item.inputs if made in found), ""):
                found[key] = changed
        return found

    def check_unchanged(self) -> None:
        """Refuse settings and code that differ from those of existing artifacts, finished or not."""
        if self.base:
            self.base.check_unchanged()
        if self._outdated:
            folders = _outermost({place for key in self._outdated for place in self._made(key)}, self.folder)
            changed = f"{' and '.join(dict.fromkeys(self._outdated.values()))} since {self.folder} was made"
            raise RecipeError(f"{changed}: give the recipe another name, or remove {' '.join(map(str, folders))}")

    def outdated(self, key: str) -> str:
        """Return what changed since the artifact `key` was made or begun; empty if nothing."""
        maker = self.maker(stage_of_key(key))
        if key not in maker._outdated:
            return ""
        this = "this" if self.has(key) else " ".join(map(str, maker._made(key)))
        return f"{maker._outdated[key]} since: give the recipe another name, or remove {this}"

    def _made(self, key: str) -> list[Path]:
        """Return the folders of a finished or begun artifact, if there is one."""
        return [self.folder / key] if self.has(key) else begun_beside(self.folder / key)

    @property
    def results(self) -> Path:
        """The folder of published results."""
        return self.path.parent / "results"

    def published(self) -> list[Path]:
        """Return the published results that are there of this recipe and, if it borrows evaluations, of its base."""
        names = dict.fromkeys((self.maker("evaluate").path.stem, self.path.stem))
        files = [file for name in names if (file := self.results / name / JSON).exists()]
        for file in files:
            if changed := self._changed_since(read_results(file)):
                since = f"{changed} in {self.path} since the results in {file} were made"
                raise RecipeError(f"{since}: move them away to publish the new ones without them")
        return files

    def _changed_since(self, found: Results) -> str:
        """Return what of the settings of tested rows is other than in results."""
        makers: set[str] = set()
        for row in found.tested():
            with suppress(BadInputError):  # of a method that is no more
                makers |= {*filter(None, (base_method(row), grounded_as(row), method_named(row).initial))}
        tables_of = {METHODS[maker].table for maker in makers}

        def compared(settings: Mapping[str, Any]) -> dict[str, Any]:
            own, data = settings.get("user_methods") or {}, settings.get("data")
            own = {name: {**table, "method": None} for name, table in own.items() if name in makers}
            asked = {*STAGES} - {"select", "report"} | {table.name for table in tables_of if table}
            tables = {name: table for name, table in settings.items() if name in asked}
            task, data = Path(str(settings.get("task"))).name, data if data and is_address(data) else None
            return {"task": task, "data": data} | tables | own

        before, now = (dict[str, Any](of) for of in (found.settings, self.recipe.settings))
        old, new = ({*((of.get("sweep") or {}).get("percent") or [None])} for of in (before, now))
        text = _changes(compared(before), compared(now), self.recipe)
        return text or ("" if new <= old else "sweep changed")


def load_experiment(path: Path, root: Path) -> Experiment:
    """Read the recipe at `path`, whose artifacts are in a folder of its name in `root`, and its base."""
    tables, base = read_tables(path), None
    if "based_on" in tables:
        name = tables["based_on"]
        known = sorted({file.stem for file in path.parent.glob("*.toml")} - {path.stem})
        if name not in known:
            raise RecipeError(f"{path}: based_on: unknown recipe '{name}'{did_you_mean(str(name), known)}")
        base_path = path.with_name(f"{name}.toml")
        below = read_tables(base_path)
        if "based_on" in below:
            raise RecipeError(f"{path}: based_on: expected a recipe that is not based on another, got '{name}'")
        base = Experiment(validated(below, Recipe, str(base_path)), base_path, root / base_path.stem)
        if "select" not in tables and isinstance(seeds := tables.get("seeds"), list) and len(seeds) < 2:
            below.pop("select", None)  # it takes groundings of other seeds
        tables = _laid_over(below, tables)
    recipe = validated(tables, Recipe, str(path))
    if base:
        _check_fit(recipe, base, path)
    return Experiment(recipe, path, root / path.stem, base)


def _changes(before: Mapping[str, Any], now: Mapping[str, Any], recipe: Recipe) -> str:
    """Say which tables and files differ between what an artifact was made with and would be made with.

    Settings that did not exist then have their defaults, as they took effect.
    """
    texts = []
    for name in dict.fromkeys((*before, *now)):
        old, new = before.get(name), now.get(name)
        if name == "code":
            texts += [f"{file} changed" for file, _, _ in changed_values(old or {}, new or {})]
            continue
        table = METHODS[name].table if name in METHODS else None  # several methods may read one
        config = getattr(recipe, table.name if table else name, None)
        if isinstance(old, dict) and isinstance(config, Config):
            old = {key: value for key, value in old.items() if key in type(config).model_fields}  # a key may be no more
            with suppress(RecipeError):
                old = validated(old, type(config), name).model_dump(mode="json")
        if old != new:
            are_tables = isinstance(old, dict) and isinstance(new, dict)
            values = changed_values(old or {}, new or {}) if are_tables else [("", old, new)]
            found = [f"{f'{key}: ' if key else ''}{_shown(one)}, now {_shown(other)}" for key, one, other in values]
            texts.append(f"{name} ({first_few(found, _MOST_KEYS)}) changed in the recipe")
    return " and ".join(texts)


def _shown(value: object) -> str:
    text = "none" if value is None else json.dumps(value, default=str)
    return text if isinstance(value, str) else shortened(text, _MOST_LETTERS)


def _outermost(places: Collection[Path], root: Path) -> list[Path]:
    """Return the folders that hold nothing but `places`, and those places that are in none of these."""
    found = set(places)
    while True:
        whole = {parent for place in found if (parent := place.parent) != root and found >= {*parent.iterdir()}}
        if not whole:
            return sorted(found)
        found = {place for place in found if place.parent not in whole} | whole


def _laid_over(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tables of a recipe over those of its base; `data` and `[collect]` replace each other."""
    replaced = {"data": "collect", "collect": "data"}
    found = {key: value for key, value in below.items() if replaced.get(key) not in above}
    for key, new in above.items():
        old = below.get(key)
        found[key] = old | new if isinstance(old, dict) and isinstance(new, dict) else new
    return found


def _check_fit(recipe: Recipe, base: Experiment, path: Path) -> None:
    name, faults, (ours, theirs) = base.path.stem, [], (recipe.task, base.recipe.task)
    targets = {task_named(task).target_id for task in (ours, theirs)}
    if ours != theirs and (len(targets) > 1 or None in targets):
        faults = [f"task: expected that of {name}, '{theirs}', or one with the same target, got '{ours}'"]
    for key in ("methods", "seeds"):
        known = getattr(base.recipe, key)
        advice = f"it has {list(known)}: add it to those of {base.path} and run that, or leave out based_on"
        unknown = [value for value in getattr(recipe, key) if value not in known]
        faults += [f"{key}: {name} has no '{value}', {advice}" for value in unknown]
    if faults:
        raise RecipeError(f"{path} does not fit what it is based on: {'; '.join(faults)}")


@dataclass(frozen=True)
class Condition:
    """The condition of an artifact, why, and warnings of its content, where there is something to say."""

    state: Literal["finished", "missing", "damaged", "stale"]
    why: str = ""
    warnings: tuple[str, ...] = ()


def condition(item: Item, experiment: Experiment, *, verify: bool = False) -> Condition:
    """Return the condition of the artifact of `item`; with `verify`, every byte of it is read."""
    if not experiment.has(item.key):
        begun = experiment.outdated(item.key)
        return Condition("stale", begun) if begun else Condition("missing")
    folder, faults, made_from = experiment.place(item.key), list[str](), dict[str, str]()
    try:
        if STAGES[item.stage].makes_dataset:
            dataset = Dataset.open(folder)
            faults = dataset.verify() if verify else []
            made_from = {parent["hash"]: parent["hash"] for parent in dataset.description["parents"]}
        elif manifest := read_manifest(folder):
            faults, made_from = manifest.faults(folder, verify=verify), dict(manifest.made_from)
        else:
            faults = [f"{MANIFEST} is missing"]
    except AstraDataError as error:
        faults = [str(error)]
    if faults:
        return Condition("damaged", "; ".join(faults))
    why = experiment.outdated(item.key) or _replaced(item, experiment, made_from)
    return Condition("stale", why) if why else Condition("finished")


def to_make_again(items: Collection[Item], experiment: Experiment) -> dict[str, str]:
    """Return which finished artifacts of `items`, each after those it reads, to make again: key to reason.

    Those are the damaged and the stale ones, and what was made from them. Every byte of what they read is compared.
    """
    known = {item.key: item for item in items}
    absent = {key for key, item in known.items() if item.stage in ALWAYS_NEW or not experiment.has(key)}
    reasons, verified, to_check = dict[str, str](), set[str](), known.keys() - absent
    while to_check:
        found = {key: condition(known[key], experiment, verify=bool(verified)) for key in to_check}
        reasons.update({key: f"{of.state} ({of.why})" for key, of in found.items() if of.state != "finished"})
        for item in items:
            source = next((key for key in item.inputs if key in reasons), None)
            if source and item.key not in absent:
                reasons.setdefault(item.key, f"made from {source}")
        made = absent | reasons.keys()
        to_check = {key for item in items if item.key in made for key in item.inputs if key in known} - made - verified
        verified |= to_check
    return {key: reasons[key] for key in known if key in reasons}


def _replaced(item: Item, experiment: Experiment, made_from: Mapping[str, str]) -> str:
    """Return which of the artifacts that `item` is made from it was not made from."""
    data = experiment.recipe.data
    if item.stage == "label" and data and not is_address(data):
        with suppress(AstraDataError):
            named, made = open_dataset(data), read_description(experiment.place(item.key))
            known = {made["content_hash"], *(parent["hash"] for parent in made["parents"])}
            # What was made of it since, and has its name, is no other.
            if known.isdisjoint(content_hash for *_, content_hash in lineage(named)):
                return f"made from another dataset than {named.reference}"
    read = {key: _digest(key, experiment) if experiment.has(key) else None for key in item.inputs}
    for key, digest in read.items():
        if item.key == "select" and key not in made_from:  # a choice is among the policies that the recipe has now
            return f"made without {key}"
        if digest not in (None, *made_from.values()):
            return f"made from another {key}"
    # A test was in the reference of all rows, which may be another now that a row is no more.
    others = [name for name, digest in made_from.items() if digest not in read.values()]
    return f"made from another {others[0]}" if others and item.stage == "evaluate" and all(read.values()) else ""


def _digest(key: str, experiment: Experiment) -> str | None:
    """Return the digest by which later artifacts name the artifact `key`; None if it cannot be read."""
    folder, stage = experiment.place(key), STAGES[stage_of_key(key)]
    with suppress(AstraDataError, OSError, KeyError):
        if stage.makes_dataset:
            return str(read_description(folder)["content_hash"])
        if manifest := read_manifest(folder):
            return manifest.files[str(stage.result)][1]
    return None


def data_condition(experiment: Experiment) -> Condition | None:
    """Return the condition of `data`, which fit task and finished seeds; None without any, or if yet to be pulled."""
    recipe = experiment.recipe
    if recipe.data is None or is_address(recipe.data):
        return None
    try:
        source = open_dataset(recipe.data)
    except BadInputError as error:
        raise BadInputError(f"data: {str(error).rstrip('.')}: import or pull it first") from None
    if ABSTRACT_STATE in source.features:
        advice = "name the dataset that this one was made from (see `astra-data log`)"
        raise BadInputError(f"data: {source.reference} is paired already, but a recipe pairs its data itself: {advice}")
    labels, others = [item for item in experiment.items.values() if item.stage == "label"], dict[str, str]()
    for key in (item.key for item in labels if condition(item, experiment).state == "finished"):
        made = read_description(place := experiment.place(key))
        used = identity_of(made) if place.is_symlink() else next(iter(made["parents"]), identity_of(made))
        if used["hash"] != source.content_hash:
            others[key] = full_name(used)
    if others and len(others) < len(labels):
        before = " and ".join(dict.fromkeys(others.values()))
        advice = f"name {before} as data, or remove {' '.join(str(experiment.folder / key) for key in others)}"
        raise BadInputError(f"data: {source.reference} is not {before}, which other seeds were made from: {advice}")
    task = task_named(recipe.task)
    check_fits(source, task)
    source.specs(recipe.align.inputs)
    grounds = any(method_named(row).grounds for row in recipe.methods)
    if grounds and not source.held_out.any():
        name, recordings = source.reference, len(set(source.recordings))
        if recipe.sweep.percent:
            smallest = min(recipe.sweep.percent)
            name, recordings = f"{smallest} % of {name}", min(recordings, share(smallest, len(source)))
        divided(name, recordings, recipe.ground.held_out_share, seed=0)  # refuses to hold out all
    warnings = (*_differing_bounds(task.limits, source), *remarks(source, task))
    return Condition("finished", warnings=warnings)


def _differing_bounds(limits: Commands, source: Dataset) -> list[str]:
    """Return a line for each axis whose bounds go beyond the commands in `source`, or are in other units."""
    statistics, lines = source.statistics(), list[str]()
    least, largest = (np.asarray(statistics[ACTION][end], float) for end in ("min", "max"))
    for (name, (low, high)), lowest, highest in zip(limits.items(), least, largest, strict=True):
        known = f"{name} may be {low:.4g} to {high:.4g}, recorded is {lowest:.4g} to {highest:.4g}: "
        if highest - lowest > TIMES * (high - low):
            lines.append(known + "are both in the same unit?")
        elif max(lowest - low, high - highest) > BEYOND * (highest - lowest):
            lines.append(known + "narrow the bounds of the commands, or record more")
    return lines
