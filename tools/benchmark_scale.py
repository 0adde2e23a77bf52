"""Measure processor time and peak memory of work on large datasets, each piece in a process of its own.

    uv run python tools/benchmark_scale.py 8000x500 80000x3
    uv run python tools/benchmark_scale.py 40000x500 --only write,read,pair,subset,validate --folder /mnt/big

Datasets of so many episodes and steps each are written below the folder and removed at the end: random values in
the columns of the task antmaze-umaze, 29 of them a state.
"""

import json
import os
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

TASK = "antmaze-umaze"
CELL_M = (-4.0, 4.0)  # center of its first cell
SIZE = 29  # values of its states
WORK: dict[str, str] = {
    "write": "write(Path('all'), {episodes}, {steps})",
    "read": "read_one(Path('all'))",
    "inspect": "inspect all",
    "validate": "validate all",
    "pair": f"pair all --simulator {TASK} --out pairs",
    "subset": "subset all --percent 50 --out half",
    "merge": "merge all half --new-uids --out merged",
    "filter": "filter all --min-length 2 --out kept",
    "load": "load_all(Path('all'))",
    "lerobot": "read_one_with_lerobot(Path('all'))",
}
"""Pieces of work in their order, as later ones read what earlier ones write: calls below, or commands."""


def main(
    sizes: Annotated[list[str], typer.Argument(metavar="EPISODESxSTEPS")],
    only: Annotated[str, typer.Option(help="Pieces of work, separated by commas.")] = ",".join(WORK),
    folder: Annotated[Path | None, typer.Option(help="Where there is room.", show_default="a temporary one")] = None,
    json_path: Annotated[Path | None, typer.Option("--json", help="Write the figures there.")] = None,
) -> None:
    """Print a table for each size."""
    figures = {}
    for size in sizes:
        episodes, steps = map(int, size.split("x"))
        with tempfile.TemporaryDirectory(dir=folder) as root:
            figures[size] = measured(Path(root), episodes, steps, only.split(","))
        table = Table("", "processor time, s", "peak memory, MB", "written, MB", title=size)
        for name, row in figures[size].items():
            table.add_row(name, *(f"{figure:,.1f}" for figure in row.values()))
        Console().print(table)
    if json_path is not None:
        json_path.write_text(json.dumps(figures, indent=2) + "\n")


def measured(root: Path, episodes: int, steps: int, names: list[str]) -> dict[str, dict[str, float]]:
    """Return seconds, and megabytes of memory and on disk, of each piece of work."""
    found: dict[str, dict[str, float]] = {}
    tools = Path(__file__).parent.resolve()
    environment = os.environ | {"PYTHONPATH": f"{tools.parent}:{tools}", "HF_HUB_OFFLINE": "1"}
    environment |= {"HF_DATASETS_CACHE": str(root / "huggingface"), "ASTRA_DATA_CACHE": str(root / "cache")}
    before = 0.0
    for name in names:
        work = WORK[name].format(episodes=episodes, steps=steps)
        command = ["-m", "astra_data", *work.split()]
        if "(" in work:
            command = ["-c", f"from pathlib import Path; from benchmark_scale import *; {work}"]
        with (root / "log").open("w") as log:
            child = subprocess.Popen([sys.executable, *command], cwd=root, env=environment, stdout=log, stderr=log)
            _, status, used = os.wait4(child.pid, 0)
        if status:
            raise SystemExit(f"{name}: {(root / 'log').read_text()}")
        after = sum(path.stat().st_size for path in root.rglob("*") if path.is_file()) / 1e6
        seconds, peak_mb = used.ru_utime + used.ru_stime, used.ru_maxrss / 1e3
        found[name] = {"processor_s": seconds, "peak_mb": peak_mb, "written_mb": after - before}
        before = after
    return found


def write(root: Path, episodes: int, steps: int) -> None:
    """Write random episodes, within a cell of the maze."""
    names, writing = (import_module(f"astra_data.dataset.{module}") for module in ("columns", "writer"))
    role = {"role": ["position"] * 2 + ["invariant"] * (SIZE - 2)}
    columns = [names.Column(name, size=SIZE, astra=role) for name in (names.STATE, names.NEXT_STATE)]
    columns += [names.Column(names.ACTION, size=2), *names.OUTCOME_COLUMNS]
    description = {"name": "scale", "stage": "collect", "environment": {"id": TASK}}
    rng, last = np.random.default_rng(0), np.arange(steps) == steps - 1
    with writing.DatasetWriter(root, columns, fps=20, task="walk", description=description) as writer:
        for uid in range(episodes):
            state = 0.1 * rng.standard_normal((steps + 1, SIZE), np.float32)
            state[:, :2] += CELL_M
            values = dict.fromkeys((names.TERMINATED, names.SUCCESS), np.zeros(steps, bool))
            values |= dict.fromkeys((names.TRUNCATED, names.DONE), last)
            values |= {names.STATE: state[:-1], names.NEXT_STATE: state[1:]}
            values |= {names.ACTION: rng.uniform(-1, 1, (steps, 2)).astype(np.float32)}
            values |= {names.REWARD: rng.standard_normal(steps, np.float32)}
            writer.add(names.Episode(uid, values, {"success": False}))


def read_one(root: Path) -> None:
    """Open a dataset and read the episode in its middle."""
    dataset = import_module("astra_data").Dataset.open(root)
    next(dataset.episodes(episodes=[len(dataset) // 2]))


def load_all(root: Path) -> None:
    """Load every column."""
    package = import_module("astra_data")
    package.Frames.load(package.Dataset.open(root))


def read_one_with_lerobot(root: Path) -> None:
    """Open a dataset with lerobot, which copies it into its cache, and read a step in its middle."""
    dataset = import_module("lerobot.datasets.lerobot_dataset").LeRobotDataset("a/b", root=root)
    dataset[len(dataset) // 2]


if __name__ == "__main__":
    typer.run(main)
