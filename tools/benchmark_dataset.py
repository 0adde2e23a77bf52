"""Measure how fast datasets are written, loaded and drawn from, against LeRobot, Minari and plain HDF5.

    uv run python tools/benchmark_dataset.py
    uv run python tools/benchmark_dataset.py --json runs/dataset.json

All figures come from one process on the same data, 200 episodes of 500 steps by default; the candidates take
turns, so that the ratios hold even on a machine that does other work too. LeRobot's writer and loader are
given fewer steps per turn, because they are slow; the table says how many.
"""

import json
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from itertools import cycle
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from dataset_peers import BATCH, COLUMNS, DRAWN, FPS, LENGTH, Hdf5, LeRobot, Minari, frames_of
from rich.console import Console
from rich.table import Table
from timing import Candidates, Stretch, measure

from astra_data.dataset.columns import ABSTRACT_STATE, ACTION, DONE, REWARD, STATE, Array, Episode
from astra_data.dataset.frames import Frames
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter


def main(
    episodes: Annotated[int, typer.Option(help="Episodes.")] = 200,
    steps: Annotated[int, typer.Option(help="Steps of each.", min=LENGTH + 1)] = 500,
    rounds: Annotated[int, typer.Option(help="Turns that each candidate takes.")] = 5,
    json_path: Annotated[Path | None, typer.Option("--json", help="Write the figures there.")] = None,
) -> None:
    """Print rates, and ours over each of the others'."""
    torch.set_num_threads(1)
    figures: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as name, quiet_libraries(Path(name)) as lerobot:
        data = random_walks(episodes, steps)
        for title, candidates in measurements(Path(name), data, lerobot):
            figures[title] = {name: rate.clock for name, rate in measure(candidates, rounds).items()}
    table = Table("", "per second", "ours is", title=f"{episodes} episodes of {steps} steps, one torch thread")
    for title, rates in figures.items():
        table.add_section()
        table.add_row(f"[bold]{title}")
        for candidate, figure in rates.items():
            table.add_row(f"  {candidate}", f"{figure:,.0f}", f"{rates['ours'] / figure:,.2f} x")
    Console().print(table)
    if json_path is not None:
        report = {"episodes": episodes, "steps": steps, "rounds": rounds, "per_second": figures}
        json_path.write_text(json.dumps(report, indent=2) + "\n")


def measurements(root: Path, data: list[Episode], lerobot: Any) -> Iterator[tuple[str, Candidates]]:  # noqa: ANN401
    """Yield what is measured: a title and the candidates; what one writes, the next ones read."""
    ours, theirs = root / "ours", LeRobot(lerobot, root)
    minari_set, hdf5 = Minari(root), Hdf5(root)
    few = data[:2]
    yield (
        "frames written",
        {
            "ours": lambda: write(ours, data),
            f"LeRobot, {frames_of(few)} frames": lambda: theirs.write(few),
            "Minari, HDF5": lambda: minari_set.write(data),
            "robomimic's HDF5": lambda: hdf5.write(data),
        },
    )
    frames = Frames.load(Dataset.open(ours), DRAWN)
    theirs.open(ours)
    minari_set.open()
    hdf5.open()
    yield (
        "frames loaded",
        {
            "ours": lambda: len(Frames.load(Dataset.open(ours), DRAWN)),
            "LeRobot": theirs.load,
            "Minari, HDF5": minari_set.load,
            "robomimic's HDF5": hdf5.load,
        },
    )
    windows, padded = frames.windows(LENGTH), frames.windows(LENGTH, padding="edge")
    loader = torch.utils.data.DataLoader(windows, BATCH, shuffle=True, collate_fn=lambda batch: batch)
    yield (
        f"windows of {LENGTH} steps drawn",
        {
            "ours": drawing(windows.batches(BATCH), 100),
            "ours, padded": drawing(padded.batches(BATCH), 100),
            "ours in a DataLoader": drawing(loader, 50),
            f"LeRobot in a DataLoader, {BATCH} windows": drawing(theirs.loader(LENGTH), 1),
            "Minari, HDF5": minari_set.windows,
            "robomimic's HDF5": hdf5.windows,
        },
    )
    yield (
        "transitions drawn",
        {
            "ours": drawing(frames.transitions().batches(BATCH), 100),
            f"LeRobot in a DataLoader, {4 * BATCH} transitions": drawing(theirs.loader(1), 4),
            "robomimic's HDF5": hdf5.transitions,
        },
    )


def random_walks(episodes: int, steps: int) -> list[Episode]:
    """Make smooth random episodes."""
    rng = np.random.default_rng(0)

    def values(size: int) -> Array:
        return (0.01 * rng.normal(size=(steps, size)).cumsum(0)).astype(np.float32)

    last = np.arange(steps) == steps - 1
    return [
        Episode(
            uid, {STATE: values(29), ABSTRACT_STATE: values(4), ACTION: values(2), REWARD: values(1)[:, 0], DONE: last}
        )
        for uid in range(episodes)
    ]


def write(root: Path, data: list[Episode]) -> int:
    """Write our dataset, with its statistics, hash and validation."""
    shutil.rmtree(root, ignore_errors=True)
    description = {"name": "walks", "stage": "import"}
    with DatasetWriter(root, COLUMNS, fps=FPS, task="walk", description=description) as writer:
        for episode in data:
            writer.add(episode)
    return frames_of(data)


def drawing(batches: Any, count: int) -> Stretch:  # noqa: ANN401 - ours, or a DataLoader
    """Draw `count` batches, epoch after epoch."""
    endless = (batch for _ in cycle([None]) for batch in batches)

    def stretch() -> int:
        return sum(len(next(endless)[STATE]) for _ in range(count))

    return stretch


@contextmanager
def quiet_libraries(root: Path) -> Iterator[Any]:
    """Point the libraries' caches below `root`, off the network, and yield lerobot's dataset module."""
    os.environ |= {
        "HF_DATASETS_CACHE": str(root / "cache"),
        "HF_HUB_OFFLINE": "1",
        "MINARI_DATASETS_PATH": str(root / "minari"),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import_module("datasets").disable_progress_bars()
        yield import_module("lerobot.datasets.lerobot_dataset")


if __name__ == "__main__":
    typer.run(main)
