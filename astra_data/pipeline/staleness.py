"""Which stages, and which rows of them, depend on which table of a recipe."""

from collections.abc import Collection

from astra_data.core.naming import base_method, is_plus
from astra_data.methods import METHODS, tables
from astra_data.pipeline.stages.registry import STAGES

SIMULATOR = "simulator"
"""Stands for the difference between two tasks with the same target."""
ROWS_TABLES = tables().keys() | {"plus", "ground", "align"}
"""Tables of a recipe that only some rows read."""


def reads(row: str, table: str) -> bool:
    """Return whether a row, or the row that it is initialized from, depends on `table`.

    A row whose method is not known here may have been grounded and aligned.
    """
    if table == "plus":
        return is_plus(row)
    method = METHODS.get(base_method(row))
    if method is None:
        return table in ("ground", "align")
    read = {"ground": method.grounds, "align": method.aligns}
    ours = method.table and method.table.name
    return read.get(table, table == ours) or (method.initial is not None and reads(method.initial, table))


def stale_stages(changed: set[str], begun: Collection[str] = ()) -> set[str]:
    """Return the stages that are affected when the keys `changed` of a recipe change, or those `begun`."""
    stale = set(begun)
    for stage in STAGES:
        more = {"collect": ("sweep",), "label": ("data",), "train": ("plus",)}
        sections = {"task", stage, *more.get(stage, ())}
        sections |= set() if stage == "collect" else {SIMULATOR}
        sections |= {
            method.table.name for method in METHODS.values() if method.table and method.configures == stage
        }
        if changed & sections or stale.intersection(STAGES[stage].reads):
            stale.add(stage)
    return stale
