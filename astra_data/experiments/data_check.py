"""The data that a recipe names, looked at before anything long begins."""

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ABSTRACT_STATE, ACTION
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import open_dataset
from astra_data.experiments.condition import Condition
from astra_data.experiments.recipe import Recipe
from astra_data.stages.label import check_fits, is_address
from astra_data.worlds.commands import Commands
from astra_data.worlds.registry import task_named

BEYOND = 0.05
"""Share of the recorded range by which bounds may be wider without a word."""


def data_condition(recipe: Recipe) -> Condition | None:
    """Return the condition of a recipe's `data`; None if it has none, or has yet to pull it.

    Raises:
        BadInputError: there are no such data, their columns are not those of the task, or they were paired.
    """
    if recipe.data is None or is_address(recipe.data):
        return None
    try:
        source = open_dataset(recipe.data)
    except BadInputError as error:
        raise BadInputError(f"data: {error}: import or pull it first") from None
    if ABSTRACT_STATE in source.features:
        raise BadInputError(
            f"data: {source.reference} has been paired, and a recipe pairs by itself: give it the dataset "
            "that this one was made from, as `astra-data log` tells"
        )
    task = task_named(recipe.task)
    check_fits(source, task)
    return Condition("finished", "; ".join(unrecorded(task.limits, source)))


def unrecorded(limits: Commands, source: Dataset) -> list[str]:
    """Return a line for each axis whose bounds go beyond the commands in `source`.

    A policy will ask for them, and neither a correction nor a predicted reward knows what follows.
    """
    statistics = source.statistics()
    if isinstance(statistics, str):
        return []
    least, largest = (np.asarray(statistics[ACTION][end], float) for end in ("min", "max"))
    return [
        f"{name} may be {low:.4g} to {high:.4g}, recorded is {lowest:.4g} to {highest:.4g}: "
        "narrow the bounds of the commands, or record more"
        for (name, (low, high)), lowest, highest in zip(limits.items(), least, largest, strict=True)
        if max(lowest - low, high - highest) > BEYOND * (highest - lowest)
    ]
