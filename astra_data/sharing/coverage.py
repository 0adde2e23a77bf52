"""Draw where a dataset has been: the planar positions of all its steps."""

import json

import numpy as np

from astra_data.columns import STATE, Column
from astra_data.dataset import Dataset
from astra_data.dataset import format as layout
from astra_data.figures.coverage import coverage
from astra_data.figures.style import png

CELLS = 64
"""Along the longer side."""


def coverage_figure(dataset: Dataset) -> bytes | None:
    """Return a histogram of the first (x, y) with the role "position" as PNG, None where there is none."""
    columns = sorted(dataset.schema, key=lambda column: column.name != STATE)
    found = next((column for column in columns if "position" in _roles(column)), None)
    if found is None:
        return None
    first = _roles(found).index("position")
    statistics = json.loads((dataset.root / layout.STATS_PATH).read_text(encoding="utf-8"))[found.name]
    low, high = (np.array(statistics[key][first : first + 2], dtype=np.float64) for key in ("min", "max"))
    # Square cells, also where all positions lie on one line or in one point.
    cell = max(float((high - low).max()), 1e-6) / CELLS
    x, y = (
        lowest + cell * np.arange(max(1, int(np.ceil(side / cell - 1e-9))) + 1)
        for lowest, side in zip(low, high - low, strict=True)
    )
    counts = np.zeros((len(x) - 1, len(y) - 1))
    for episode in dataset.episodes([found.name]):
        position = episode.columns[found.name][:, first : first + 2].astype(np.float64)
        # The highest position may lie beyond the last edge by rounding.
        inside = np.minimum(position, [x[-1], y[-1]])
        counts += np.histogram2d(inside[:, 0], inside[:, 1], bins=(x, y))[0]
    names = found.names or [f"{found.name}[{index}]" for index in range(found.size)]
    units = (found.astra or {}).get("unit") or ["m"] * found.size
    labels = [f"{names[index]} ({units[index]})" for index in (first, first + 1)]
    return png(coverage(counts, (x, y), (labels[0], labels[1])))


def _roles(column: Column) -> list[str]:
    return list((column.astra or {}).get("role", []))
