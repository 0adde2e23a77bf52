"""Measure how long commands that read a dataset take: read, subset, merge, pair and export.

    uv run python tools/benchmark_operations.py
    uv run python tools/benchmark_operations.py --episodes 20000 --steps 40 --json runs/operations.json

The dataset has the columns of AntMaze with random values. Run in two checkouts, the figures say what a change
costs; times are those of the processor, the least of some rounds, because machines do other work too.
"""

import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import Annotated

import numpy as np
import torch
import typer
from rich.console import Console
from rich.table import Table

from astra_data.core.progress import silent
from astra_data.dataset import Dataset, DatasetWriter
from astra_data.dataset.columns import OUTCOME_COLUMNS, STATE, Array, Episode
from astra_data.dataset.edit import merge, subset
from astra_data.exchange.exporters import export
from astra_data.stages.pair import PairConfig, pair
from astra_data.worlds.registry import TASKS

TASK = "antmaze-umaze"


def main(
    episodes: Annotated[int, typer.Option(help="Episodes.")] = 2000,
    steps: Annotated[int, typer.Option(help="Steps of each.")] = 500,
    rounds: Annotated[int, typer.Option(help="How often each is done; the least time counts.")] = 3,
    json_path: Annotated[Path | None, typer.Option("--json", help="Write the figures there.")] = None,
) -> None:
    """Print the processor seconds of each operation."""
    torch.set_num_threads(1)
    seconds: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        half = episodes // 2
        write(folder / "first", range(half), steps)
        write(folder / "second", range(half, episodes), steps)
        whole = merge([Dataset.open(folder / "first"), Dataset.open(folder / "second")], out=folder / "whole")
        for title, operation in operations(folder, whole).items():
            seconds[title] = min(timed(operation, folder / "made") for _ in range(rounds))
    table = Table("", "processor seconds", title=f"{episodes} episodes of {steps} steps")
    for title, figure in seconds.items():
        table.add_row(title, f"{figure:.2f}")
    Console().print(table)
    if json_path is not None:
        report = {"episodes": episodes, "steps": steps, "rounds": rounds, "processor_seconds": seconds}
        json_path.write_text(json.dumps(report, indent=2) + "\n")


def operations(folder: Path, whole: Path) -> dict[str, Callable[[Path], object]]:
    """Return what is measured; each writes to a path, if anything."""

    def opened(name: str) -> Dataset:
        return Dataset.open(folder / name)

    return {
        "open": lambda _: Dataset.open(whole),
        "read all columns": lambda _: Dataset.open(whole).columns(list(Dataset.open(whole).features)),
        "subset of 100 %": lambda out: subset(opened("whole"), percent=100, out=out),
        "subset of 50 %": lambda out: subset(opened("whole"), percent=50, out=out),
        "merge": lambda out: merge([opened("first"), opened("second")], out=out),
        "pair": lambda out: pair(TASK, PairConfig(), dataset=whole, out=out, progress=silent),
        "export to D4RL": lambda out: export(opened("whole"), out, format="d4rl"),
        "export to d3rlpy": lambda out: export(opened("whole"), out, format="d3rlpy"),
    }


def timed(operation: Callable[[Path], object], out: Path) -> float:
    """Return the processor seconds of `operation`; what it writes is removed."""
    began = process_time()
    operation(out)
    spent = process_time() - began
    if out.is_dir():
        shutil.rmtree(out)
    out.unlink(missing_ok=True)
    return spent


def write(root: Path, uids: range, steps: int) -> None:
    """Write a dataset of random episodes."""
    rng = np.random.default_rng(uids.start)
    columns = [*TASKS[TASK].state_columns, *OUTCOME_COLUMNS]
    description = {"name": "random", "stage": "import", "environment": {"id": TASK}}
    with DatasetWriter(root, columns, fps=20, task="walk", description=description) as writer:
        for uid in uids:
            last = np.arange(steps) == steps - 1
            values: dict[str, Array] = {column.name: last for column in columns if column.dtype == "bool"}
            for column in columns:
                if column.dtype == "float32":
                    shape = (steps, column.size)[: 1 + (column.size > 1)]
                    values[column.name] = rng.normal(size=shape).astype(np.float32)
            values[STATE] = values[STATE].clip(-1, 1)
            writer.add(Episode(uid, values, {"success": True, "return": float(uid)}))


if __name__ == "__main__":
    typer.run(main)
