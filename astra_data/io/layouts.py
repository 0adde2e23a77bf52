"""Names of our columns in the files of other libraries, for importers and exporters."""

from collections.abc import Iterable, Mapping

from astra_data.core.arrays import as_rows
from astra_data.dataset.columns import (
    ACTION,
    GOAL,
    NEXT_STATE,
    REWARD,
    STATE,
    TERMINATED,
    TRUNCATED,
    Array,
)

D4RL = {
    STATE: "observations",
    ACTION: "actions",
    REWARD: "rewards",
    TERMINATED: "terminals",
    TRUNCATED: "timeouts",
    NEXT_STATE: "next_observations",
    GOAL: "infos/goal",
}
ROBOMIMIC = {ACTION: "actions", REWARD: "rewards", TERMINATED: "dones", TRUNCATED: "truncated"}
"""Per demonstration; its learners take `dones` for terminated, and `truncated` is ours."""
D3RLPY = {STATE: "observations", ACTION: "actions", REWARD: "rewards", TERMINATED: "terminated"}
"""Per episode, with its number at the end of the name; `terminated` is a single value."""
MINARI = {ACTION: "actions", REWARD: "rewards", TERMINATED: "terminations", TRUNCATED: "truncations"}

NUMBERED = "{field}_{number}"
"""The pattern of episodes whose fields have the episode's number at the end of their names."""
RECORD = "metadata/astra_data"
"""Where HDF5 files hold the record of an export."""


VECTORS = (STATE, NEXT_STATE, GOAL, ACTION)
"""Columns that are vectors in every format, (T, size), also those of one value a step."""


def fields_of(columns: Iterable[str], own: Mapping[str, str]) -> dict[str, str]:
    """Return the field of each of the columns: a format's own name, or another one, among its infos."""
    infos = {name: f"infos/{name}" for name in columns}
    taken = own.values()
    return {name: own.get(name, f"{field}_" if field in taken else field) for name, field in infos.items()}


def as_stored(name: str, values: Array) -> Array:
    """Return a column's values (T,) or (T, size) in the shape that the formats have it."""
    return as_rows(values) if name in VECTORS else values
