"""The entries of a task's columns, one row each."""

import re
from collections.abc import Sequence
from typing import NamedTuple

from astra_data.dataset.columns import Column


class ColumnEntry(NamedTuple):
    """One value of a column, in the words of `Column.astra`."""

    name: str
    unit: str
    frame: str
    role: str


PLANAR_STATE = (
    ColumnEntry("x", "m", "world", "position"),
    ColumnEntry("y", "m", "world", "position"),
    ColumnEntry("vx", "m/s", "world", "vector"),
    ColumnEntry("vy", "m/s", "world", "vector"),
)
"""Abstract states of a robot in the plane."""

PLANAR_GOAL = (
    ColumnEntry("goal_x", "m", "world", "position"),
    ColumnEntry("goal_y", "m", "world", "position"),
)


def column(name: str, entries: Sequence[ColumnEntry], meaning: str) -> Column:
    """Return the column `name` with `entries`."""
    names, units, frames, roles = zip(*entries, strict=True)
    astra = {"unit": [*units], "frame": [*frames], "role": [*roles]}
    return Column(name, size=len(entries), names=names, meaning=meaning, astra=astra)


def names_with_units(column: Column) -> list[str]:
    """Return the names of a column's values, with units where these are known: "speed_m_s"."""
    words = [
        "_".join(re.findall("[a-z0-9]+", unit.replace("²", "2").replace("°", "deg"))) for unit in column.units
    ]
    return [
        name if word in ("", "1") or name.endswith(f"_{word}") else f"{name}_{word}"
        for name, word in zip(column.labels, words, strict=True)
    ]


def repeated_names(column: Column | None) -> list[str]:
    """Return the names that several values of a column have, each once; none of no column."""
    names = (column.names if column else None) or ()
    return sorted({name for name in names if names.count(name) > 1})


def free_body(joints: Sequence[str]) -> list[ColumnEntry]:
    """Return the entries of MuJoCo's qpos, then qvel, of a free body with hinge `joints`, in their order."""
    return [
        ColumnEntry("x", "m", "world", "position"),
        ColumnEntry("y", "m", "world", "position"),
        ColumnEntry("z", "m", "world", "invariant"),
        *(ColumnEntry(name, "1", "world", "quaternion") for name in ("qw", "qx", "qy", "qz")),
        *(ColumnEntry(joint, "rad", "joint", "invariant") for joint in joints),
        ColumnEntry("vx", "m/s", "world", "vector"),
        ColumnEntry("vy", "m/s", "world", "vector"),
        ColumnEntry("vz", "m/s", "world", "invariant"),
        ColumnEntry("wx", "rad/s", "body", "invariant"),
        ColumnEntry("wy", "rad/s", "body", "invariant"),
        ColumnEntry("wz", "rad/s", "body", "invariant"),
        *(ColumnEntry(f"{joint}_rate", "rad/s", "joint", "invariant") for joint in joints),
    ]
