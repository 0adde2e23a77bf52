"""The condition of a run's artifacts and data: finished, missing, damaged (not what its manifest says), or stale.

Stale is what was made from something else than what lies there now, or was made or begun with other settings.
"""

from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np

from astra_data.core.artifact import MANIFEST, read_manifest
from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.core.naming import stage_of_key
from astra_data.dataset.columns import ABSTRACT_STATE, ACTION
from astra_data.dataset.compare import hashes, lineage, recordings_of
from astra_data.dataset.description import read_description
from astra_data.dataset.edit import share
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import open_dataset
from astra_data.grounding.paired_episodes import divided
from astra_data.io.hub.stores import is_address
from astra_data.methods import method_named
from astra_data.pipeline.executors import Item
from astra_data.pipeline.experiment import ALWAYS_NEW, Experiment
from astra_data.pipeline.recipe import Recipe
from astra_data.pipeline.stages.label import check_fits, remarks
from astra_data.pipeline.stages.registry import STAGES
from astra_data.robots.registry import task_named
from astra_data.worlds.commands import Commands

BEYOND = 0.05
"""Share of the recorded range by which bounds may be wider without a warning."""
TIMES = 20
"""How many times as wide as the bounds the recorded range may be without a warning."""


@dataclass(frozen=True)
class Condition:
    """The condition of an artifact, why, and warnings of its content, where there is something to say."""

    state: Literal["finished", "missing", "damaged", "stale"]
    why: str = ""
    warnings: tuple[str, ...] = ()

    @property
    def is_finished(self) -> bool:
        """Whether the artifact can be used."""
        return self.state == "finished"


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
        reasons.update({key: f"{of.state} ({of.why})" for key, of in found.items() if not of.is_finished})
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
            if not known & hashes(lineage(named)):
                return f"made from another dataset than {named.reference}"
    for key in item.inputs:
        # A choice is among the policies that the recipe has now.
        if item.key == "select" and key not in made_from:
            return f"made without {key}"
        if experiment.has(key) and _digest(key, experiment) not in (None, *made_from.values()):
            return f"made from another {key}"
    return ""


def _digest(key: str, experiment: Experiment) -> str | None:
    """Return the digest by which later artifacts name the artifact `key`; None if it cannot be read."""
    folder, stage = experiment.place(key), STAGES[stage_of_key(key)]
    with suppress(AstraDataError, OSError, KeyError):
        if stage.makes_dataset:
            return str(read_description(folder)["content_hash"])
        if manifest := read_manifest(folder):
            return manifest.files[str(stage.result)][1]
    return None


def data_condition(recipe: Recipe) -> Condition | None:
    """Return the condition of a recipe's `data`, which fit its task; None if it has none, or has yet to pull it."""
    if recipe.data is None or is_address(recipe.data):
        return None
    try:
        source = open_dataset(recipe.data)
    except BadInputError as error:
        raise BadInputError(f"data: {str(error).rstrip('.')}: import or pull it first") from None
    if ABSTRACT_STATE in source.features:
        raise BadInputError(
            f"data: {source.reference} is paired already, but a recipe pairs its data itself: name the "
            "dataset that this one was made from (see `astra-data log`)"
        )
    task = task_named(recipe.task)
    check_fits(source, task)
    grounds = any(method_named(row).grounds for row in recipe.methods)
    if grounds and not any(source.metadata.get("held_out", ())):
        name, recordings = source.reference, len(set(recordings_of(source)))
        if recipe.sweep.percent:
            smallest = min(recipe.sweep.percent)
            name, recordings = f"{smallest} % of {name}", min(recordings, share(smallest, len(source)))
        divided(name, recordings, recipe.ground.held_out_share, seed=0)  # refuses to hold out all
    warnings = (*_differing_bounds(task.limits, source), *remarks(source, task))
    return Condition("finished", warnings=warnings)


def _differing_bounds(limits: Commands, source: Dataset) -> list[str]:
    """Return a line for each axis whose bounds go beyond the commands in `source`, or are in other units."""
    statistics, lines = source.statistics(), list[str]()
    if isinstance(statistics, str):
        return []
    least, largest = (np.asarray(statistics[ACTION][end], float) for end in ("min", "max"))
    for (name, (low, high)), lowest, highest in zip(limits.items(), least, largest, strict=True):
        known = f"{name} may be {low:.4g} to {high:.4g}, recorded is {lowest:.4g} to {highest:.4g}: "
        if highest - lowest > TIMES * (high - low):
            lines.append(known + "are both in the same unit?")
        elif max(lowest - low, high - highest) > BEYOND * (highest - lowest):
            lines.append(known + "narrow the bounds of the commands, or record more")
    return lines
