"""The data that a recipe names, looked at before anything long begins."""

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ABSTRACT_STATE, ACTION
from astra_data.dataset.compare import recordings_of
from astra_data.dataset.edit import share
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import open_dataset
from astra_data.grounding.paired_episodes import divided
from astra_data.io.hub.stores import is_address
from astra_data.methods import method_named
from astra_data.pipeline.condition import Condition
from astra_data.pipeline.recipe import Recipe
from astra_data.pipeline.stages.label import check_fits, remarks
from astra_data.robots.registry import task_named
from astra_data.worlds.commands import Commands

BEYOND = 0.05
"""Share of the recorded range by which bounds may be wider without a word."""
TIMES = 20
"""How many times as wide as the bounds the recorded range may be without a word."""


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
