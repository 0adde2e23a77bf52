"""Measure what it costs that everything written survives a power failure, against `--no-fsync`.

    uv run python tools/benchmark_fsync.py --folder runs

The candidates take turns. The figures depend on the disk that the folder is on; in memory (tmpfs) it costs
nothing.
"""

import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from timing import OURS, Stretch, measure, print_rates

from astra_data.core.checkpoint import save_tensors
from astra_data.core.durable import NO_FSYNC
from astra_data.dataset import DatasetWriter, StagedWriter
from astra_data.dataset.columns import ACTION, STATE, Column, Episode

COLUMNS = (Column(STATE, size=29), Column(ACTION, size=8))
STEPS = 500
SETTINGS = {"fps": 20, "task": "walk", "description": {"name": "walks", "stage": "collect"}}


def main(
    folder: Annotated[Path, typer.Option(help="On the disk to measure.")] = Path("runs"),
    episodes: Annotated[int, typer.Option(help="Episodes of 500 steps.")] = 200,
    values: Annotated[int, typer.Option(help="Values of a checkpoint.")] = 1_000_000,
    rounds: Annotated[int, typer.Option(help="Turns that each candidate takes.")] = 5,
    json_path: Annotated[Path | None, typer.Option("--json", help="Write the figures there.")] = None,
) -> None:
    """Print rates, and ours over those without fsync."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    data = [
        Episode(uid, {c.name: rng.normal(size=(STEPS, c.size)).astype(np.float32) for c in COLUMNS})
        for uid in range(episodes)
    ]
    weights = {"weights": torch.ones(values)}
    with tempfile.TemporaryDirectory(dir=folder) as name:
        root = Path(name)
        works = {
            "episodes written": lambda: write(DatasetWriter, root / "set", data),
            "episodes recorded, each safe at once": lambda: write(StagedWriter, root / "set", data),
            f"checkpoints of {values:,} values": lambda: checkpoint(root / "checkpoint", weights),
        }
        rates = {
            title: measure({OURS: with_fsync(work, ""), "--no-fsync": with_fsync(work, "1")}, rounds)
            for title, work in works.items()
        }
    print_rates(rates)
    if json_path is not None:
        report = {
            title: {name: asdict(rate) for name, rate in found.items()} for title, found in rates.items()
        }
        json_path.write_text(json.dumps(report, indent=2) + "\n")


def write(writer: type[DatasetWriter] | type[StagedWriter], root: Path, data: list[Episode]) -> float:
    """Write a dataset."""
    shutil.rmtree(root, ignore_errors=True)
    with writer(root, COLUMNS, **SETTINGS) as opened:  # type: ignore[arg-type]
        for episode in data:
            opened.add(episode)
    return len(data)


def checkpoint(path: Path, weights: dict[str, torch.Tensor]) -> float:
    """Write ten checkpoints."""
    for _ in range(10):
        save_tensors(path, weights, {})
    return 10


def with_fsync(work: Callable[[], float], setting: str) -> Stretch:
    """Do `work` with the environment variable `NO_FSYNC` at `setting`."""

    def stretch() -> float:
        os.environ[NO_FSYNC] = setting
        return work()

    return stretch


if __name__ == "__main__":
    typer.run(main)
