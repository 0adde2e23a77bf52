"""The condition of a run's artifacts and data: whether each is finished, missing, damaged or stale, and why.

An artifact is damaged if it is not what its manifest says, or a dataset that cannot be opened; it is stale if
it was made from something else than what lies there now, or was made or begun with other settings.
"""

from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from astra_data.core.artifact import MANIFEST, Manifest, read_manifest
from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.core.naming import stage_of_key
from astra_data.dataset.columns import ABSTRACT_STATE, ACTION
from astra_data.dataset.compare import hashes, lineage, recordings_of
from astra_data.dataset.description import read_description
from astra_data.dataset.edit import share
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import open_dataset
from astra_data.grounding.files import load_grounding, load_target_encoder
from astra_data.grounding.paired_episodes import divided
from astra_data.io.hub.stores import is_address
from astra_data.methods import method_named
from astra_data.pipeline.executors import Item
from astra_data.pipeline.experiment import ALWAYS_NEW, Experiment
from astra_data.pipeline.recipe import Recipe
from astra_data.pipeline.stages.label import check_fits, remarks
from astra_data.pipeline.stages.registry import STAGES, Stage
from astra_data.policies.running_policy import PolicyFile
from astra_data.reports.artifacts import Evaluation, read_json
from astra_data.reports.choice import Judged
from astra_data.robots.registry import task_named
from astra_data.worlds.commands import Commands

LOADERS: dict[str, Callable[[Path], object]] = {
    "ground": load_grounding,
    "train": PolicyFile.load,
    "align": load_target_encoder,
    "select": lambda path: read_json(Judged, path),
    "evaluate": lambda path: read_json(Evaluation, path),
}
"""What reads the results of stages as other stages do."""


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
    key = item.key
    if not experiment.has(key):
        begun_otherwise = experiment.outdated(key)
        return Condition("stale", begun_otherwise) if begun_otherwise else Condition("missing")
    faults, manifest = examined(key, experiment, verify=verify)
    if why := faults or (verify and _unreadable(key, experiment)):
        return Condition("damaged", why)
    if why := experiment.outdated(key) or _replaced(item, experiment, manifest):
        return Condition("stale", why)
    return Condition("finished", _remark(key, experiment, manifest))


def spoilt(item: Item, experiment: Experiment) -> str:
    """Return why the finished artifact of `item` cannot be read by others, every byte considered; "" if not.

    Of datasets, whose values are compared whenever they are read, only the metadata are.
    """
    why, manifest = examined(item.key, experiment, verify=not _stage(item.key).makes_dataset)
    if why:
        return f"damaged ({why})"
    why = _replaced(item, experiment, manifest)
    return f"stale ({why})" if why else ""


def examined(key: str, experiment: Experiment, *, verify: bool) -> tuple[str, Manifest | None]:
    """Return what is wrong with the files of the artifact `key`, and its manifest; of datasets, None.

    Their sizes are compared or, with `verify`, their bytes. Of datasets, it is what the metadata and the
    footers of the files show or, with `verify`, all values.
    """
    folder, stage = experiment.place(key), _stage(key)
    manifest = None
    try:
        if stage.makes_dataset:
            dataset = Dataset.open(folder)
            faults = dataset.verify() if verify else []
        elif manifest := read_manifest(folder):
            faults = manifest.faults(folder, verify=verify)
        else:
            faults = [f"{MANIFEST} is missing"]
    except AstraDataError as error:
        return str(error), None
    return "; ".join(faults), manifest


def to_make_again(items: Collection[Item], experiment: Experiment) -> dict[str, str]:
    """Return which finished artifacts of `items` have to be made again, key to reason.

    Those are the damaged and the stale ones, and what was made from them. Of all, the sizes are compared, of
    what an item to make reads, every byte.

    Args:
        items: each after those it reads.
        experiment: whose artifacts they are.
    """
    absent = {item.key for item in items if item.stage in ALWAYS_NEW or not experiment.has(item.key)}
    reasons: dict[str, str] = {}
    for item in items:
        found = condition(item, experiment)
        if item.key not in absent and not found.is_finished:
            reasons[item.key] = f"{found.state} ({found.why})"
    verified: set[str] = set()
    while True:
        for item in items:
            source = next((key for key in item.inputs if key in reasons), None)
            if source and item.key not in absent:
                reasons.setdefault(item.key, f"made from {source}")
        made = absent | reasons.keys()
        read = {key for item in items if item.key in made for key in item.inputs}
        read = (read & {item.key for item in items}) - made - verified
        if not read:
            return reasons
        verified |= read
        faults = {key: examined(key, experiment, verify=True)[0] for key in sorted(read)}
        reasons |= {key: f"damaged ({why})" for key, why in faults.items() if why}


def can_be_made_again(key: str, experiment: Experiment) -> bool:
    """Return whether a stage made the artifact `key`; a dataset may also have been put there."""
    stage = _stage(key)
    if not stage.makes_dataset:
        return True
    if (link := experiment.place(key)).is_symlink() and _other_data(link, experiment.recipe.data):
        return True
    with suppress(AstraDataError):
        return bool(read_description(experiment.place(key))["stage"] == stage.name)
    return False


def _stage(key: str) -> Stage:
    return STAGES[stage_of_key(key)]


def _unreadable(key: str, experiment: Experiment) -> str:
    """Return why later stages cannot read the artifact `key`, such as weights that are not finite."""
    stage = _stage(key)
    try:
        if stage.result:
            LOADERS[stage.name](experiment.place(key) / stage.result)
    except AstraDataError as error:
        return f"{error}, after removing this"
    return ""


def _replaced(item: Item, experiment: Experiment, manifest: Manifest | None) -> str:
    """Return which of the artifacts that `item` is made from it was not made from, by its manifest."""
    folder = experiment.place(item.key)
    if item.stage == "label" and (data := _other_data(folder, experiment.recipe.data)):
        return f"made from another dataset than {data}"
    made_from: Collection[str]
    if _stage(item.key).makes_dataset:
        made_from = [parent["hash"] for parent in read_description(folder)["parents"]]
    elif manifest:
        made_from = manifest.made_from.values()
        # A choice is among the policies that the recipe has now.
        absent = [key for key in item.inputs if item.key == "select" and key not in manifest.made_from]
        if absent:
            return f"made without {absent[0]}"
    else:
        return ""
    digests = {key: _digest(key, experiment) for key in item.inputs if experiment.has(key)}
    others = [key for key, digest in digests.items() if digest and digest not in made_from]
    return f"made from another {others[0]}" if others else ""


def _other_data(labeled: Path, data: str | None) -> str:
    """Return the reference of the dataset that a recipe names, if another one was labeled."""
    if data is None or is_address(data):
        return ""
    with suppress(AstraDataError):
        named, made = open_dataset(data), read_description(labeled)
        known = {made["content_hash"], *(parent["hash"] for parent in made["parents"])}
        # What was made of it since, and has its name, is no other.
        return "" if known & hashes(lineage(named)) else named.reference
    return ""


def _digest(key: str, experiment: Experiment) -> str | None:
    """Return the digest by which later artifacts name the artifact `key`; None if it cannot be read."""
    folder, stage = experiment.place(key), _stage(key)
    with suppress(AstraDataError, OSError, KeyError):
        if stage.makes_dataset:
            return str(read_description(folder)["content_hash"])
        manifest = read_manifest(folder)
        return manifest.files[str(stage.result)][1] if manifest else None
    return None


def _remark(key: str, experiment: Experiment, manifest: Manifest | None) -> str:
    """Return what is unusual about a finished artifact with this manifest."""
    if manifest is None:
        return ""
    foreign = manifest.foreign(experiment.place(key))
    return f"not of it: {', '.join(foreign)}" if foreign else ""


def data_condition(recipe: Recipe) -> Condition | None:
    """Return the condition of a recipe's `data`; None if it has none, or has yet to pull it.

    Raises:
        BadInputError: there are no such data, their columns are not those of the task, they were paired, or
            none is left to train on where some are held out, in the smallest size of a sweep.
        CorruptDatasetError: a file of theirs cannot be read.
    """
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
    if any(method_named(row).grounds for row in recipe.methods):
        _check_division(recipe, source)
    warnings = (*differing_bounds(task.limits, source), *remarks(source, task))
    return Condition("finished", warnings=warnings)


def _check_division(recipe: Recipe, source: Dataset) -> None:
    """Refuse data of which grounding would hold out all, unless they say which are held out."""
    if any(source.metadata.get("held_out", ())):
        return
    name, recordings = source.reference, len(set(recordings_of(source)))
    if recipe.sweep.percent:
        smallest = min(recipe.sweep.percent)
        name, recordings = f"{smallest} % of {name}", min(recordings, share(smallest, len(source)))
    divided(name, recordings, recipe.ground.held_out_share, seed=0)


def differing_bounds(limits: Commands, source: Dataset) -> list[str]:
    """Return a line for each axis whose bounds go beyond the commands in `source`, or are of another size.

    A policy will ask for the former, and neither a correction nor a predicted reward knows what follows; the
    latter are in other units.
    """
    statistics = source.statistics()
    if isinstance(statistics, str):
        return []
    least, largest = (np.asarray(statistics[ACTION][end], float) for end in ("min", "max"))
    lines = []
    for (name, (low, high)), lowest, highest in zip(limits.items(), least, largest, strict=True):
        known = f"{name} may be {low:.4g} to {high:.4g}, recorded is {lowest:.4g} to {highest:.4g}: "
        if highest - lowest > TIMES * (high - low):
            lines.append(known + "are both in the same unit?")
        elif max(lowest - low, high - highest) > BEYOND * (highest - lowest):
            lines.append(known + "narrow the bounds of the commands, or record more")
    return lines
