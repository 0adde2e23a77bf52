"""The artifacts that a recipe's rows, seeds and sizes need, each once.

    collect ──┬── (augment) ── pair ──┬── ground ──┬── train ──┬── evaluate ──┬── report
    or label ─┘                       │            └── align ──┘              │
                                      │   (all seeds of ground and train) ── (select)
                                      └── (rows without grounding train on the pairs alone)

`<method>_plus` shares the grounding and the alignment of `<method>`. Where a recipe sweeps over sizes, what comes
before is made of the largest once, `subset` makes each size of it, and all from ground on is made for each.
"""

import inspect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import takewhile
from pathlib import Path
from typing import Any

from pydantic import JsonValue

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.core.naming import artifact_key, base_method, reference_of
from astra_data.io.hub.stores import is_address
from astra_data.methods import grounded_as, method_named
from astra_data.pipeline.executors import Item
from astra_data.pipeline.recipe import Recipe, digests_of
from astra_data.pipeline.stages.registry import STAGES, Stage
from astra_data.pipeline.stages.select import benches, judge_of
from astra_data.reports.runs import Reported, Selection
from astra_data.robots.registry import task_named

ARTIFACTS = ("dataset", "policy", "grounding", "target_encoder", "reference", "initial")  # folders, as parameters


def selected(
    recipe: Recipe, methods: Sequence[str] = (), seeds: Sequence[int] = (), percents: Sequence[int] = ()
) -> Selection:
    """Return those of a recipe that are named; of an axis on which nothing is named, all."""
    for method in methods:
        if method not in recipe.methods:
            raise BadInputError(f"the recipe has no method '{method}'{did_you_mean(method, recipe.methods)}")
    sizes = recipe.sweep.percent
    for what, asked, known in (("seed", seeds, recipe.seeds), ("size", percents, sizes)):
        if unknown := [value for value in asked if value not in known]:
            listed = ", ".join(map(str, known)) or "none"
            raise BadInputError(f"the recipe has no {what} {unknown[0]}; its {what}s: {listed}")
    return Selection(
        tuple(dict.fromkeys(methods)) or recipe.methods,
        tuple(dict.fromkeys(seeds)) or recipe.seeds,
        tuple(dict.fromkeys(percents)) or sizes,
    )


def plan(
    recipe: Recipe,
    path: Path,
    folder: Path,
    selection: Selection | None = None,
    *,
    device: str = "cpu",
    reports: Selection | None = None,
    publish: Path | None = None,
    published: Sequence[Path] = (),
) -> tuple[Item, ...]:
    """Return every artifact of the `recipe` at `path`, each after those it reads, seed after seed, and its report.

    A `selection` is made; what the report is of, `reports`, is by default all that is finished of the recipe.
    """
    selection, reports = selection or selected(recipe), reports or selected(recipe)
    items = list(_Plan(recipe, folder, selection, device).items())
    keys = tuple(selection.points())
    about: dict[str, Any] = {"name": path.stem, "task": recipe.task, "settings": recipe.settings}
    chosen, reported = (Reported(**vars(part), **about) for part in (selection, reports))
    if recipe.select and len(selection.seeds) > 1:
        of = benches(chosen, judge_of(recipe.select.judge, recipe.methods))
        if any(bench.entries for bench in of):  # there are policies to judge
            inputs = tuple(dict.fromkeys(key for bench in of for key in bench.keys))
            call = partial(STAGES["select"].run, chosen, recipe.select, root=folder)
            settings = {"select": recipe.select.model_dump(mode="json")}
            items.append(Item("select", inputs, call, settings=settings))
            keys += ("select",)
    command = _command(recipe, path, reports)
    to: dict[str, Any] = {"root": folder, "command": command, "publish": publish, "published": published}
    return (*items, Item("report", keys, partial(STAGES["report"].run, reported, **to, config=recipe.report)))


def stages_until(last: str | None) -> set[str]:
    """Return the stages up to `last`, by default all."""
    check_stage(last or "report")
    return set(list(STAGES)[: list(STAGES).index(last or "report") + 1])


def check_stage(stage: str) -> None:
    """Refuse an unknown stage."""
    if stage not in STAGES:
        raise BadInputError(f"unknown stage '{stage}'{did_you_mean(stage, STAGES)}")


@dataclass(frozen=True)
class _Plan:
    """The artifacts of a recipe, except its report."""

    recipe: Recipe
    folder: Path
    selection: Selection
    device: str

    @cached_property
    def _names(self) -> dict[str, tuple[str, ...]]:
        """The methods or rows for which stages make one artifact each, per dataset."""
        rows = self.selection.methods
        bases = tuple(dict.fromkeys(map(base_method, rows)))
        reference = reference_of(self.recipe.methods)
        judge = [judge_of(self.recipe.select.judge, self.recipe.methods)] if self.recipe.select else []
        candidates = (*bases, *([reference] if reference else []), *judge)
        groundings = dict.fromkeys(grounded_as(base) for base in candidates if method_named(base).grounds)
        initial = [first for base in bases if (first := method_named(base).initial)]
        trained = [row for row in rows if method_named(row).trains]
        return {
            "grounding": tuple(groundings),
            "policy": tuple(dict.fromkeys(initial + trained)),
            "alignment": tuple(base for base in groundings if method_named(base).aligns),
            "row": rows,
        }

    def items(self) -> Iterator[Item]:
        """Yield the artifacts, each after those it reads."""
        percents = self.selection.percents
        for seed in self.selection.seeds:
            for stage in STAGES.values():
                if stage.makes_dataset:
                    sizes = percents if stage.each == "size" else (None,)
                    yield from (self._item(stage, seed, size) for size in sizes if self._has(stage))
            for percent in percents or (None,):
                for stage in STAGES.values():
                    for name in self._names.get(stage.each, ()):
                        yield self._item(stage, seed, percent, name)

    def _has(self, stage: Stage) -> bool:
        if stage.each == "size":
            return bool(self.selection.percents)
        return stage.asked_by is None or getattr(self.recipe, stage.asked_by) is not None

    def _item(self, stage: Stage, seed: int, percent: int | None, name: str = "") -> Item:
        """Return the artifact that a stage makes of a dataset, for a method or row if `name` is one."""
        recipe, method = self.recipe, method_named(name) if name else None
        key = artifact_key(stage.name, name, seed, percent)
        parameters = inspect.signature(stage.run).parameters
        artifacts = self._artifacts(stage, seed, percent, name)
        keys = {parameter: artifacts[parameter] for parameter in parameters if parameter in ARTIFACTS}
        # The dataset that the policy of a row was trained on, if it is one.
        of_policy = method is not None and method.trains_without_target
        recorded = self._artifacts(STAGES["train"], seed, percent, name)["dataset"] if of_policy else None
        known = {
            "task": recipe.task,
            "simulator": recipe.task,
            "method": name,
            "config": recipe.config_of(stage.name),
            "settings": recipe.settings_of(name, stage.name) if name else None,
            "seed": seed,
            "percent": percent,
            "of": recipe.collect and recipe.collect.episodes,
            "data": recipe.data,
            "recorded": recorded and self.folder / recorded,
            "out": self.folder / key,
            "device": self.device,
            **{parameter: made and self.folder / made for parameter, made in keys.items()},
        }
        return Item(
            key,
            tuple(dict.fromkeys(made for made in keys.values() if made)),
            partial(stage.run, **{parameter: known[parameter] for parameter in parameters if parameter in known}),
            # Of the methods only some train in the target, whose physics uses several threads.
            is_threaded="num_threads" in parameters
            and (method is None or stage.each != "policy" or method.steps_target),
            device=self.device if "device" in parameters else "cpu",
            settings=self._settings(stage, name, {key: known[key] for key in known if key in parameters}),
        )

    def _settings(self, stage: Stage, name: str, given: Mapping[str, Any]) -> dict[str, JsonValue]:
        """Return what an artifact is made with, as JSON: settings, and digests of the user's code by files."""
        recipe, method = self.recipe, base_method(name)
        names = {"task": recipe.task} | {own: given.method for own, given in recipe.user_methods.items()}
        used = {"task": {"task", "simulator"} & given.keys(), method: method in names}
        code = {
            Path(names[one].rpartition(":")[0]).name: self._digests[one]
            for one in used
            if used[one] and one in self._digests
        }
        task = task_named(recipe.task)
        about: dict[str, Any] = {
            "task": Path(recipe.task).name if used["task"] else None,
            "method": name or None,
            **{key: given.get(key) for key in ("seed", "percent", "of")},
            "data": recipe.data if recipe.data and "data" in given and is_address(recipe.data) else None,
            stage.name: given["config"].model_dump(mode="json") if given.get("config") else None,
            method: given["settings"].model_dump(mode="json") if given.get("settings") else None,
            "code": code or None,
        }
        if stage.name == "collect" and task.target_id is not None:
            about["task"] = task.target_id
        return {key: value for key, value in about.items() if value is not None}

    @cached_property
    def _digests(self) -> dict[str, str]:
        return digests_of(self.recipe.task, self.recipe.user_methods)

    def _artifacts(self, stage: Stage, seed: int, percent: int | None, name: str) -> dict[str, str | None]:
        """Return the keys of the artifacts that a stage may read, by its parameters."""
        before = takewhile(lambda one: one is not stage, STAGES.values())
        datasets = [one for one in before if one.makes_dataset and self._has(one)]
        last = datasets[-1] if datasets else None
        size = percent if last and last.each == "size" else None
        artifacts = {"dataset": artifact_key(last.name, "", seed, size) if last else None}
        if not name:
            return artifacts
        method, reference = method_named(name), reference_of(self.recipe.methods) or name
        made = {
            "policy": ("train", name if method.trains else None),
            "grounding": ("ground", grounded_as(name) if method.grounds else None),
            "target_encoder": ("align", grounded_as(name) if method.aligns else None),
            "reference": ("ground", grounded_as(reference) if method_named(reference).grounds else None),
            "initial": ("train", method.initial),
        }
        return artifacts | {key: artifact_key(by, of, seed, percent) if of else None for key, (by, of) in made.items()}


def _command(recipe: Recipe, path: Path, selection: Selection) -> str:
    axes = {
        "method": (selection.methods, recipe.methods),
        "seed": (selection.seeds, recipe.seeds),
        "percent": (selection.percents, recipe.sweep.percent),
    }
    options = [f" --{name} {one}" for name, (some, whole) in axes.items() if some != whole for one in some]
    return f"astra-data run {path}{''.join(options)}"
