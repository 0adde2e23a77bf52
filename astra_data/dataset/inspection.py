"""Summary of a dataset: episodes, histograms of values, a map of the robot's positions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from astra_data.core.arrays import Floats, Ints, as_rows
from astra_data.dataset.columns import NEXT_STATE, REWARD, STATE, SUCCESS, TERMINATED, Array, Column
from astra_data.dataset.reader import Dataset

BINS = 16  # bins of a histogram, from the smallest to the largest value
CELLS = 64  # cells of a map along its longer side
NEEDED = (STATE, NEXT_STATE, TERMINATED)  # columns that show how an episode ends


@dataclass(frozen=True)
class Spread:
    """Range (size,) of a column, and how many values are in `BINS` equal bins of it, (size, BINS)."""

    column: Column
    low: Floats
    high: Floats
    mean: Floats
    counts: Ints


@dataclass(frozen=True)
class Map:
    """Visits of the square cells of a plane, indexed [y, x] from the lower left corner `origin` (2,)."""

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
    """How many episodes end in which way."""

    terminated: int = 0  # in success or failure
    cut_off: int = 0
    made_up: int = 0  # terminated ones whose last next state is the state itself, to the bit

    def add(self, columns: Mapping[str, Array]) -> None:
        """Count an episode with these columns, of which `NEEDED` are looked at."""
        ended = is_terminated(columns)
        self.terminated += ended
        self.cut_off += not ended
        if STATE in columns and NEXT_STATE in columns:
            self.made_up += ended and stands_still(columns[STATE][-1], columns[NEXT_STATE][-1])

    def __str__(self) -> str:
        made_up = f"; {self.made_up} next states of terminated episodes were made up: the state itself is used"
        return f"{self.terminated} terminated, {self.cut_off} cut off{made_up if self.made_up else ''}"


@dataclass(frozen=True)
class Inspection:
    """Summary of a dataset of E episodes; None is what is unknown."""

    reference: str
    fps: int
    lengths: Ints  # steps of each episode, (E,)
    cameras: Mapping[str, Sequence[int]]  # to the shape of their pictures
    success: int | None  # number of successful episodes
    endings: Endings | None
    spreads: tuple[Spread, ...]  # one per column
    positions: Map | None  # of the robot, in m
    velocities: Map | None  # in the plane, in m/s


def inspect_dataset(dataset: Dataset) -> Inspection:
    """Summarize `dataset`; memory stays bounded."""
    ranges, successes = dataset.statistics(), dataset.successes()
    spreads = []
    for column in dataset.schema:
        low, high, mean = (np.array(ranges[column.name][key], np.float64) for key in ("min", "max", "mean"))
        spreads.append(Spread(column, low, high, mean, np.zeros((column.size, BINS), np.int64)))
    for block in dataset.blocks([column.name for column in dataset.schema]):
        for spread in spreads:
            span = np.where(spread.high > spread.low, spread.high - spread.low, 1.0)
            bins = (as_rows(block[spread.column.name]).astype(np.float64) - spread.low) / span * BINS
            flat = np.clip(bins, 0, BINS - 1).astype(np.int64) + BINS * np.arange(spread.column.size)
            spread.counts[:] += np.bincount(flat.ravel(), minlength=spread.counts.size).reshape(spread.counts.shape)
    return Inspection(
        reference=dataset.reference,
        fps=int(dataset.info["fps"]),
        lengths=dataset.lengths,
        cameras={name: camera.feature["shape"] for name, camera in dataset.cameras.items()},
        success=None if successes is None else sum(value is True for value in successes),
        endings=endings_of(dataset) if TERMINATED in dataset.features else None,
        spreads=tuple(spreads),
        positions=visited(dataset),
        velocities=visited(dataset, "vector"),
    )


def visited(dataset: Dataset, role: str = "position") -> Map | None:
    """Map the robot's positions, or the first other planar pair of a `role` in its state; None if it has none."""
    roles = [pair for column in dataset.schema if column.name == STATE for pair in column.roles]
    group = next((group for found, group in roles if found == role), None)
    if group is None:
        return None
    ranges = dataset.statistics()[STATE]
    low, high = (np.array(ranges[key], np.float64)[group] for key in ("min", "max"))
    cell = float((high - low).max()) / CELLS or 1.0
    width, height = (max(1, int(cells)) for cells in np.ceil((high - low) / cell - 1e-9))
    counts = np.zeros((height, width), dtype=np.int64)
    for block in dataset.blocks([STATE]):
        cells = np.floor((block[STATE][:, group] - low) / cell + 1e-9)
        x, y = cells.clip(0, [width - 1, height - 1]).astype(np.int64).T
        np.add.at(counts, (y, x), 1)
    return Map(counts, low, cell)


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
    """Return what the metadata of an episode with these columns say of its outcome, as far as the columns do."""
    found: dict[str, bool | float] = {}
    if SUCCESS in columns:
        success = bool(columns[SUCCESS].any())
        found |= {"success": success, "failed": is_terminated(columns) and not success}
    return found | ({"return": float(columns[REWARD].sum(dtype=np.float64))} if REWARD in columns else {})


def stands_still(state: Array, next_state: Array) -> bool:
    """Return whether a next state is the state, to the bit."""
    return bool((state == next_state).all())
