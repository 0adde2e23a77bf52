"""Recordings for tests, as other people's libraries write them."""

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.dataset.columns import Array
from astra_data.dataset.reader import Dataset
from astra_data.io.importing import ImportReport, import_dataset

LENGTHS = (6, 9, 5)
STEPS = (5, 9, 4)
"""Of each trial: nobody recorded the next state of its last row, but the second ends in a fall."""
TABLES = ("log.csv", "log.npz", "log.h5", "log.json", "log.jsonl", "log.parquet")

LOG = 'name = "log"\ntask = "walk"\nfps = 10\n'
MAPPING = """
name = "log"
terminal = "stand_still"
task = "walk"
fps = 10
[columns."observation.state"]
fields = ["x", "y"]
scale = [0.001]
names = ["x", "y"]
unit = ["m"]
role = ["position"]
[columns.action]
fields = ["command"]
clip = [-1, 1]
[columns."next.reward"]
fields = ["reward"]
[columns."next.terminated"]
fields = ["fell"]
[columns.gait]
fields = ["gait"]
dtype = "int64"
[split]
field = "trial"
"""


def rows(seed: int = 0) -> dict[str, Array]:
    """Return three trials, one below the other."""
    rng = np.random.default_rng(seed)
    n = sum(LENGTHS)
    return {
        "x": rng.normal(0, 1000, n),
        "y": rng.normal(0, 1000, n),
        "command": rng.normal(0, 1, n),
        "reward": rng.normal(0, 1, n),
        "fell": np.arange(n) == sum(LENGTHS[:2]) - 1,
        "gait": rng.integers(0, 4, n),
        "trial": np.repeat(np.arange(len(LENGTHS)), LENGTHS),
        "unused": rng.normal(0, 1, n),
    }


def write_table(path: Path, fields: Mapping[str, Array]) -> Path:
    """Write `fields` in the format that the name of `path` tells."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".csv":
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(fields)
            writer.writerows(zip(*(values.tolist() for values in fields.values()), strict=True))
    elif path.suffix == ".npz":
        with path.open("wb") as file:
            np.savez_compressed(file, **fields)  # type: ignore[arg-type]
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            for name, values in fields.items():
                file[name] = values
    elif path.suffix == ".parquet":
        pq.write_table(pa.table({name: values.tolist() for name, values in fields.items()}), path)
    elif path.suffix in (".jsonl", ".ndjson"):
        lists = zip(*(values.tolist() for values in fields.values()), strict=True)
        lines = [json.dumps(dict(zip(fields, row, strict=True))) for row in lists]
        path.write_text("\n".join([*lines, ""]))
    else:
        path.write_text(json.dumps({name: values.tolist() for name, values in fields.items()}))
    return path


def imported(
    tmp_path: Path, sources: Path | Sequence[Path], mapping: str | None = MAPPING, **options: object
) -> tuple[Dataset, ImportReport]:
    """Import `sources` by the text of a mapping."""
    tmp_path.mkdir(exist_ok=True)
    file = None
    if mapping is not None:
        file = tmp_path / "mapping.toml"
        file.write_text(mapping)
    paths = [sources] if isinstance(sources, Path) else list(sources)
    report = import_dataset(paths, file, out=tmp_path / "out", **options)  # type: ignore[arg-type]
    return Dataset.open(report.root), report
