"""What recordings of Rerun hold."""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

RrdReader = import_module("rerun.chunk" if find_spec("rerun.chunk") else "rerun.experimental").RrdReader


def read(path: Path) -> dict[str, dict[str, Any]]:
    """Return what a recording holds: entity to component, "step" and "time" (in ns) to its rows."""
    found: dict[str, dict[str, Any]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            found.setdefault(str(chunk.entity_path), {})[name] = column
    return found


def scalars(table: dict[str, Any]) -> np.ndarray[Any, Any]:
    return np.array(table["Scalars:scalars"].to_pylist())[:, 0]
