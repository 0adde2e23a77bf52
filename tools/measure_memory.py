"""Measure how much memory it takes to write, augment, pair and validate a large dataset.

    uv run python tools/measure_memory.py
    uv run python tools/measure_memory.py --episodes 2000 --steps 250

Episodes are made one by one, so that what is held in memory is the toolkit's own; augmenting doubles them.
Each part runs in a fork of a process that holds the imports; its figure is the largest resident size above
theirs.
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

from astra_data.core.progress import silent
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, OUTCOME_COLUMNS, REWARD, STATE, Array, Episode
from astra_data.dataset.doctor.check import check
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter
from astra_data.pipeline.stages.augment import AugmentConfig, augment
from astra_data.pipeline.stages.pair import PairConfig, pair
from astra_data.robots.registry import TASKS

TASK = TASKS["antmaze-umaze"]
AMBLE_M = 0.4
"""How far the robots go from the center of their cell."""

Work = Callable[[Path, int, int], int]
"""Do something in a folder, with so many episodes of so many steps; return how many steps it was."""


def main(
    episodes: Annotated[int, typer.Option(help="Episodes, before they are doubled.")] = 20_000,
    steps: Annotated[int, typer.Option(help="Steps of each.")] = 250,
    limit_mb: Annotated[int, typer.Option(help="Exit with 1 above this many MiB.")] = 1500,
    folder: Annotated[Path | None, typer.Option(help="Where the dataset goes for a while.")] = None,
) -> None:
    """Print peak memory and frames per second of each part."""
    table = Table("", "frames", "peak MiB", "frames/s")
    peaks = []
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        for work in (write, double, pair_all, validate):
            frames, peak, seconds = apart(work, Path(scratch), episodes, steps)
            table.add_row(work.__name__, f"{frames:,}", f"{peak:,.0f}", f"{frames / seconds:,.0f}")
            peaks.append(peak)
    Console().print(table)
    if max(peaks) > limit_mb:
        raise typer.Exit(1)


def write(root: Path, episodes: int, steps: int) -> int:
    """Write ants that amble about the free cells of the maze."""
    columns = [*TASK.state_columns, *OUTCOME_COLUMNS]
    description = {"name": "large", "stage": "collect", "environment": {"id": TASK.name}}
    with DatasetWriter(
        root / "written", columns, fps=TASK.fps, task=TASK.instruction, description=description
    ) as writer:
        for episode in ambles(episodes, steps):
            writer.add(episode)
    return episodes * steps


def double(root: Path, episodes: int, steps: int) -> int:
    """Augment them with one copy of each; those that reach their goal are shorter."""
    config = AugmentConfig(copies=1, held_out_share=0.0)
    out = root / "doubled"
    augment(None, config, dataset=root / "written", seed=0, out=out, progress=silent)
    return int(Dataset.open(out).lengths.sum())


def pair_all(root: Path, episodes: int, steps: int) -> int:
    """Pair originals and copies with the point mass."""
    out = root / "paired"
    pair(TASK.name, PairConfig(), dataset=root / "doubled", out=out, progress=silent)
    return int(Dataset.open(out).lengths.sum())


def validate(root: Path, episodes: int, steps: int) -> int:
    """Check every value and all statistics."""
    report = check(root / "paired")
    assert not report.faults
    return report.frames


def ambles(episodes: int, steps: int) -> Iterator[Episode]:
    """Yield episodes of ants that go around in their cell; the rest of the state is noise."""
    rng = np.random.default_rng(0)
    centers = TASK.maze.free_centers()
    for uid in range(episodes):
        states = rng.standard_normal((steps + 1, 29), dtype=np.float32)
        angle = 0.05 * np.arange(steps + 1) + rng.uniform(-np.pi, np.pi)
        around = AMBLE_M * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        states[:, :2] = centers[uid % len(centers)] + around
        states[:, 3:7] /= np.linalg.norm(states[:, 3:7], axis=1, keepdims=True)
        last = np.arange(steps) == steps - 1
        columns: dict[str, Array] = {column.name: last for column in OUTCOME_COLUMNS}
        columns |= {
            STATE: states[:-1],
            NEXT_STATE: states[1:],
            ACTION: rng.uniform(-0.5, 0.5, (steps, 2)).astype(np.float32),
            GOAL: np.zeros((steps, 2), dtype=np.float32),
            REWARD: rng.standard_normal(steps, dtype=np.float32),
        }
        yield Episode(uid, columns, {"success": True, "return": float(columns[REWARD].sum()), "seed": uid})


def apart(work: Work, root: Path, episodes: int, steps: int) -> tuple[int, float, float]:
    """Run `work` in its own process; return its steps, its peak in MiB above the imports, its seconds."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["astra_data.pipeline.stages.augment", "astra_data.dataset.doctor.check"])
    with context.Pool(1) as pool:
        return pool.apply(_measured, (work, root, episodes, steps))


def _measured(work: Work, root: Path, episodes: int, steps: int) -> tuple[int, float, float]:
    before = _peak_mb()
    began = time.perf_counter()
    frames = work(root, episodes, steps)
    return frames, _peak_mb() - before, time.perf_counter() - began


def _peak_mb() -> float:
    # Linux's own figure: the one of getrusage also knows the peak of the process that started this one.
    [line] = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
    return int(line.split()[1]) / 1024


if __name__ == "__main__":
    typer.run(main)
