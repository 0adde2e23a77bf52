"""Measure how long commands that read a dataset take: read, subset, merge, pair and export.

    uv run python tools/benchmark_operations.py
    uv run python tools/benchmark_operations.py --episodes 20000 --steps 40 --json runs/operations.json

The dataset has the columns of AntMaze with random values. Times are those of the processor, the least of
some rounds, because machines do other work too. Beside each stands the share of it that went into verifying:
into digests and sums and, of exports, into reading back what was written.
"""

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from time import process_time
from types import ModuleType
from typing import Annotated, Any

import numpy as np
import torch
import typer
from door import run_tool
from rich.console import Console
from rich.table import Table

from astra_data.core.progress import silent
from astra_data.dataset import Dataset, DatasetWriter, reader, values, writer
from astra_data.dataset.columns import OUTCOME_COLUMNS, STATE, Array, Episode
from astra_data.dataset.edit import merge, subset
from astra_data.exchange import exporters
from astra_data.exchange.exporters import export
from astra_data.stages.pair import PairConfig, pair
from astra_data.worlds.registry import TASKS

TASK = "antmaze-umaze"
DIGESTS: tuple[tuple[ModuleType, str], ...] = (
    (reader, "read_digests"),
    (reader, "digests_of"),
    (reader, "altered_columns"),
    (values, "digests_of"),
    (writer, "digest_of"),
    (writer, "write_digests"),
    (writer, "sealed"),
)
READING_BACK = ((exporters, "_compare"),)


def main(
    episodes: Annotated[int, typer.Option(help="Episodes.")] = 2000,
    steps: Annotated[int, typer.Option(help="Steps of each.")] = 500,
    rounds: Annotated[int, typer.Option(help="How often each is done; the least time counts.")] = 3,
    json_path: Annotated[Path | None, typer.Option("--json", help="Write the figures there.")] = None,
) -> None:
    """Print the processor seconds of each operation."""
    torch.set_num_threads(1)
    figures: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        half = episodes // 2
        write(folder / "first", range(half), steps)
        write(folder / "second", range(half, episodes), steps)
        whole = merge([Dataset.open(folder / "first"), Dataset.open(folder / "second")], out=folder / "whole")
        for title, operation in operations(folder, whole).items():
            tries = [timed(operation, folder / "made") for _ in range(rounds)]
            figures[title] = min(tries, key=lambda seconds: seconds["all"])
    table = Table(
        "", "processor seconds", "digests", "reading back", title=f"{episodes} episodes of {steps} steps"
    )
    for title, seconds in figures.items():
        shares = [f"{seconds[part] / seconds['all']:.1%}" for part in ("digests", "reading back")]
        table.add_row(title, f"{seconds['all']:.2f}", *shares)
    Console().print(table)
    if json_path is not None:
        report = {"episodes": episodes, "steps": steps, "rounds": rounds, "processor_seconds": figures}
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


def timed(operation: Callable[[Path], object], out: Path) -> dict[str, float]:
    """Return the processor seconds of `operation`, and those of verifying; what it writes is removed."""
    with measured(DIGESTS) as digests, measured(READING_BACK) as reading_back:
        began = process_time()
        operation(out)
        spent = process_time() - began
    if out.is_dir():
        shutil.rmtree(out)
    out.unlink(missing_ok=True)
    return {"all": spent, "digests": sum(digests), "reading back": sum(reading_back)}


@contextmanager
def measured(functions: tuple[tuple[ModuleType, str], ...]) -> Iterator[list[float]]:
    """Collect the processor seconds of each call of `functions` of modules."""
    seconds: list[float] = []

    def watched(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def run(*arguments: object, **options: object) -> object:
            began = process_time()
            try:
                return function(*arguments, **options)
            finally:
                seconds.append(process_time() - began)

        return run

    originals = [getattr(module, name) for module, name in functions]
    for (module, name), original in zip(functions, originals, strict=True):
        setattr(module, name, watched(original))
    try:
        yield seconds
    finally:
        for (module, name), original in zip(functions, originals, strict=True):
            setattr(module, name, original)


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
    run_tool(main)
