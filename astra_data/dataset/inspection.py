"""Summary of a dataset in one pass: episodes, histograms of values, a map of the robot's positions."""

from dataclasses import dataclass

import numpy as np

from astra_data.core.arrays import Floats, Ints
from astra_data.core.errors import CorruptDatasetError
from astra_data.core.numbers import as_rows
from astra_data.dataset.columns import STATE, TERMINATED, Array, Column
from astra_data.dataset.endings import Endings
from astra_data.dataset.format import STATS_PATH
from astra_data.dataset.reader import Dataset

BINS = 16
"""Bins of a histogram, from the smallest to the largest value."""
CELLS = 64
"""Cells of a map along its longer side."""
_LARGEST = float(np.finfo(np.float32).max)
_REMEDY = "astra-data repair rebuilds it"


@dataclass(frozen=True)
class Spread:
    """Range and histogram of one column.

    Attributes:
        column: the column.
        low, high, mean: of each index, (size,).
        counts: values in each of `BINS` equal bins between low and high, (size, BINS).
    """

    column: Column
    low: Floats
    high: Floats
    mean: Floats
    counts: Ints


@dataclass(frozen=True)
class Map:
    """Visits of the cells of a plane.

    Attributes:
        counts: visits of each square cell, indexed [y, x] from the lower left, (height, width).
        origin: the lower left corner, (2,).
        cell: side of a cell, in the unit of the values.
    """

    counts: Ints
    origin: Floats
    cell: float

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top edge."""
        height, width = self.counts.shape
        (left, bottom), cell = self.origin.tolist(), self.cell
        return left, left + width * cell, bottom, bottom + height * cell


@dataclass(frozen=True)
class Inspection:
    """Summary of a dataset of E episodes.

    Attributes:
        reference: name and version.
        fps: steps per second.
        lengths: steps of each episode, (E,).
        success: number of successful episodes; None if unknown.
        endings: how the episodes end; None if unknown.
        spreads: one per column.
        positions: the robot's positions, in m; None if the state has no such role.
        velocities: its planar velocities in m/s, likewise.
    """

    reference: str
    fps: int
    lengths: Ints
    success: int | None
    endings: Endings | None
    spreads: tuple[Spread, ...]
    positions: Map | None
    velocities: Map | None


def inspect_dataset(dataset: Dataset) -> Inspection:
    """Summarize `dataset`, reading one episode at a time.

    Raises:
        CorruptDatasetError: a file cannot be read.
    """
    spreads = _empty_spreads(dataset, dataset.schema)
    maps = {role: _empty_map(spreads, role) for role in ("position", "vector")}
    endings = Endings() if TERMINATED in dataset.features else None
    for episode in dataset.episodes():
        if endings is not None:
            endings.add(episode.columns)
        for spread in spreads:
            _count(spread, episode.columns[spread.column.name])
        for found in maps.values():
            if found is not None:
                planar, group = found
                _visit(planar, episode.columns[STATE][:, group])
    successes = dataset.successes()
    return Inspection(
        reference=dataset.reference,
        fps=int(dataset.info["fps"]),
        lengths=dataset.lengths,
        success=None if successes is None else sum(value is True for value in successes),
        endings=endings,
        spreads=tuple(spreads),
        positions=maps["position"] and maps["position"][0],
        velocities=maps["vector"] and maps["vector"][0],
    )


def visited(dataset: Dataset, role: str = "position") -> Map | None:
    """Map the robot's positions, or another planar `role` of its state; None if the state has none.

    Raises:
        CorruptDatasetError: a file cannot be read.
    """
    states = [column for column in dataset.schema if column.name == STATE]
    found = _empty_map(_empty_spreads(dataset, states), role)
    if found is None:
        return None
    planar, group = found
    for episode in dataset.episodes([STATE]):
        _visit(planar, episode.columns[STATE][:, group])
    return planar


def _empty_spreads(dataset: Dataset, columns: list[Column]) -> list[Spread]:
    ranges = dataset.statistics()
    if isinstance(ranges, str):
        raise CorruptDatasetError(f"{dataset.root}: {STATS_PATH} {ranges}; {_REMEDY}")
    spreads = []
    for column in columns:
        stored = ranges.get(column.name, {})
        try:
            table = np.array([stored[key] for key in ("min", "max", "mean")], dtype=np.float64)
        except (KeyError, OverflowError, TypeError, ValueError):
            table = np.empty(0)
        if (
            table.shape != (3, column.size)
            or not (np.abs(table) <= _LARGEST).all()
            or (table[0] > table[1]).any()
        ):
            expected = f"expected {column.size} finite numbers as min, max and mean of {column.name}"
            raise CorruptDatasetError(f"{dataset.root}: {STATS_PATH} is malformed, {expected}; {_REMEDY}")
        counts = np.zeros((column.size, BINS), dtype=np.int64)
        spreads.append(Spread(column, table[0], table[1], table[2], counts))
    return spreads


def _count(spread: Spread, values: Array) -> None:
    table = as_rows(values).astype(np.float64)
    span = np.where(spread.high > spread.low, spread.high - spread.low, 1.0)
    bins = np.clip((table - spread.low) / span * BINS, 0, BINS - 1).astype(np.int64)
    flat = (bins + BINS * np.arange(spread.column.size)).ravel()
    spread.counts[:] += np.bincount(flat, minlength=spread.counts.size).reshape(spread.counts.shape)


def _empty_map(spreads: list[Spread], role: str) -> tuple[Map, slice] | None:
    """Return an empty map for the first pair with `role` in the state, and the pair's indices."""
    for spread in spreads:
        for found, group in spread.column.roles if spread.column.name == STATE else ():
            if found == role:
                low, span = spread.low[group], spread.high[group] - spread.low[group]
                cell = float(span.max()) / CELLS or 1.0
                width, height = (max(1, int(cells)) for cells in np.ceil(span / cell - 1e-9))
                return Map(np.zeros((height, width), dtype=np.int64), low, cell), group
    return None


def _visit(planar: Map, points: Array) -> None:
    height, width = planar.counts.shape
    cells = np.floor((points - planar.origin) / planar.cell + 1e-9)
    x, y = cells.clip(0, [width - 1, height - 1]).astype(np.int64).T
    np.add.at(planar.counts, (y, x), 1)
