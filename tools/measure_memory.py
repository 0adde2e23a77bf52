"""Measure how much memory it takes to write and to validate a large dataset.

    uv run python tools/measure_memory.py
    uv run python tools/measure_memory.py --episodes 4000 --steps 250

Episodes are made one by one, so that what is held in memory is the toolkit's own. Each part runs in a process
of its own; its figure is the largest resident size above that of the imports.
"""

import multiprocessing
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from astra_data.columns import (
    ABSTRACT_NEXT_STATE,
    ABSTRACT_STATE,
    ACTION,
    NEXT_STATE,
    OUTCOME_COLUMNS,
    REWARD,
    STATE,
    Column,
    Episode,
)
from astra_data.dataset import Dataset, DatasetWriter

COLUMNS = [
    Column(STATE, size=29),
    Column(NEXT_STATE, size=29),
    Column(ACTION, size=2),
    Column(ABSTRACT_STATE, size=4),
    Column(ABSTRACT_NEXT_STATE, size=4),
    *OUTCOME_COLUMNS,
]
Work = Callable[[Path, int, int], None]
"""Do something with the dataset in a folder, which has so many episodes of so many steps."""


def main(
    episodes: Annotated[int, typer.Option(help="Episodes.")] = 40_000,
    steps: Annotated[int, typer.Option(help="Steps of each.")] = 250,
    limit_mb: Annotated[int, typer.Option(help="Exit with 1 above this many MiB.")] = 1500,
    folder: Annotated[Path | None, typer.Option(help="Where the dataset goes for a while.")] = None,
) -> None:
    """Print peak memory and frames per second of writing and of validating once more."""
    table = Table("", "peak MiB", "frames/s", title=f"{episodes:,} episodes of {steps} steps")
    peaks = []
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        root = Path(scratch) / "set"
        for work in (write, validate):
            peak, seconds = apart(work, root, episodes, steps)
            table.add_row(work.__name__, f"{peak:,.0f}", f"{episodes * steps / seconds:,.0f}")
            peaks.append(peak)
    Console().print(table)
    if max(peaks) > limit_mb:
        raise typer.Exit(1)


def write(root: Path, episodes: int, steps: int) -> None:
    """Write the dataset."""
    description = {"name": "large", "stage": "import"}
    with DatasetWriter(root, COLUMNS, fps=20, task="walk", description=description) as writer:
        for episode in random_walks(episodes, steps):
            writer.add(episode)


def validate(root: Path, episodes: int, steps: int) -> None:
    """Open the dataset and read every value."""
    dataset = Dataset.open(root)
    assert (len(dataset), dataset.lengths.sum()) == (episodes, episodes * steps)
    assert dataset.verify() == []


def random_walks(episodes: int, steps: int) -> Iterator[Episode]:
    """Yield episodes of smooth random values; their metadata is what collected ones have."""
    rng = np.random.default_rng(0)
    for uid in range(episodes):
        columns = {}
        for column in COLUMNS:
            shape = (steps, column.size) if column.size > 1 else (steps,)
            if column.dtype == "bool":
                columns[column.name] = np.arange(steps) == steps - 1
            else:
                columns[column.name] = rng.standard_normal(shape, dtype=np.float32).cumsum(0)
        facts = {"success": True, "return": float(columns[REWARD].sum()), "seed": uid}
        yield Episode(uid, columns, facts)


def apart(work: Work, root: Path, episodes: int, steps: int) -> tuple[float, float]:
    """Run `work` in a process of its own; return its peak in MiB above the imports, and its seconds."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_measured, (work, root, episodes, steps))


def _measured(work: Work, root: Path, episodes: int, steps: int) -> tuple[float, float]:
    before = _peak_mb()
    began = time.perf_counter()
    work(root, episodes, steps)
    return _peak_mb() - before, time.perf_counter() - began


def _peak_mb() -> float:
    # Linux's own figure: the one of getrusage also knows the peak of the process that started this one.
    [line] = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
    return int(line.split()[1]) / 1024


if __name__ == "__main__":
    typer.run(main)
