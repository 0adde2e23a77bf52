"""What a LeRobot dataset of another tool declares: its columns of numbers, its rate, its name."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset import columns as names
from astra_data.dataset.columns import Column
from astra_data.dataset.format import DEFAULT_COLUMNS, INFO_PATH
from astra_data.dataset.plain import MOST_FPS, PlainColumn, plain_columns

DTYPES = {"f": "float32", "i": "int64", "u": "int64", "b": "bool"}
"""Ours, by the kind of the stored values."""


def declared_columns(folder: Path, info: Mapping[str, Any]) -> tuple[list[PlainColumn], list[Column], int]:
    """Return from info.json the columns of numbers as stored, the ones of ours for their values, and the fps.

    Raises:
        CorruptDatasetError: it lacks LeRobot's own columns, or a whole number of frames per second.
    """
    features, fps = info.get("features"), info.get("fps")
    columns = plain_columns(features)[0] if isinstance(features, dict) else []
    found = {column.name: column for column in columns}
    missing = sorted({c.name for c in DEFAULT_COLUMNS} - found.keys())
    faults = [f"lacks the columns {', '.join(missing)}, which are LeRobot's own"] if missing else []
    if strange := [c.name for c in DEFAULT_COLUMNS if c.name in found and not _fits(found[c.name], c)]:
        faults.append(f"has no single number a step as {', '.join(strange)}")
    if not isinstance(fps, int | float) or not 1 <= fps < MOST_FPS or fps != int(fps):
        faults.append(f"has fps {fps!r}, expected a whole number of frames per second")
    if faults:
        raise CorruptDatasetError(f"{folder}: {INFO_PATH} {' and '.join(faults)}")
    assert isinstance(features, dict) and isinstance(fps, int | float)
    specs = []
    for column in columns:
        if column.name in names.RESERVED:
            continue
        feature = features[column.name]
        known = feature | {
            "dtype": DTYPES[np.dtype(column.dtype).kind],
            "names": _labels(feature.get("names"), column.size),
        }
        specs.append(Column.from_feature(column.name, known))
    return columns, specs, int(fps)


def _fits(stored: PlainColumn, own: Column) -> bool:
    """Return whether a column can be one of LeRobot's own."""
    kinds = "f" if own.dtype == "float32" else "iu"
    return stored.size == 1 and np.dtype(stored.dtype).kind in kinds


def name_of(folder: Path) -> str:
    """Return a valid name of a dataset, from that of its folder."""
    name = re.sub(r"[^A-Za-z0-9._-]+|^[^A-Za-z0-9]+", "-", folder.resolve().name)
    return name.lstrip("-._") or "repaired"


def robot_of(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return what info.json says of the robot, as the environment of a dataset of ours."""
    robot = info.get("robot_type")
    return {"robot_type": robot} if isinstance(robot, str) else {}


def _labels(labels: object, size: int) -> list[str] | None:
    """Return a name per value, where `labels` has them: as a list, alone in an object or in another list."""
    while isinstance(labels, dict | list) and len(labels) == 1:
        [inner] = labels.values() if isinstance(labels, dict) else labels
        if not isinstance(inner, dict | list):
            break
        labels = inner
    fits = isinstance(labels, list) and [type(label) for label in labels] == [str] * size
    return list(labels) if fits and isinstance(labels, list) else None
