"""Summary of a dataset in one pass: episodes, histograms of values, a map of the robot's positions."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from astra_data.core.arrays import Floats, Ints, as_rows
from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.columns import NEXT_STATE, REWARD, STATE, SUCCESS, TERMINATED, Array, Column
from astra_data.dataset.format import STATS_PATH
from astra_data.dataset.reader import Dataset

BINS = 16
"""Bins of a histogram, from the smallest to the largest value."""
CELLS = 64
"""Cells of a map along its longer side."""
_LARGEST = float(np.finfo(np.float32).max)
_REMEDY = "astra-data repair rebuilds it"
NEEDED = (STATE, NEXT_STATE, TERMINATED)
"""Columns that show how an episode ends."""


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


@dataclass
class Endings:
    """How many episodes end in which way.

    Attributes:
        terminated: those that end in success or failure. cut_off: the others.
        made_up: those whose last next state is the state itself, to the bit, where they are terminated.
    """

    terminated: int = 0
    cut_off: int = 0
    made_up: int = 0

    def add(self, columns: Mapping[str, Array]) -> None:
        """Count an episode with these columns, of which `NEEDED` are looked at."""
        ended = is_terminated(columns)
        self.terminated += ended
        self.cut_off += not ended
        if STATE in columns and NEXT_STATE in columns:
            self.made_up += ended and stands_still(columns[STATE][-1], columns[NEXT_STATE][-1])

    def __str__(self) -> str:
        """Summarize them in a line."""
        return f"{self.terminated} terminated, {self.cut_off} cut off" + (
            f"; {self.made_up} next states of terminated episodes were made up: the state itself is used"
            if self.made_up
            else ""
        )


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
    """Summarize `dataset`, reading one episode at a time."""
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
    """Map the robot's positions, or another planar `role` of its state; None if the state has none."""
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


def endings_of(dataset: Dataset) -> Endings:
    """Return how the episodes of `dataset` end, reading one at a time."""
    found = Endings()
    for episode in dataset.episodes([name for name in NEEDED if name in dataset.features]):
        found.add(episode.columns)
    return found


def is_terminated(columns: Mapping[str, Array]) -> bool:
    """Return whether an episode with these columns is known to end in success or failure."""
    return TERMINATED in columns and bool(columns[TERMINATED][-1])


def outcome_of(columns: Mapping[str, Array]) -> dict[str, bool | float]:
    """Return what the metadata of an episode with these columns say of its outcome."""
    success = bool(columns[SUCCESS].any())
    return {
        "success": success,
        "failed": is_terminated(columns) and not success,
        "return": float(columns[REWARD].sum(dtype=np.float64)),
    }


def stands_still(state: Array, next_state: Array) -> bool:
    """Return whether a next state is the state, to the bit."""
    return bool((state == next_state).all())
