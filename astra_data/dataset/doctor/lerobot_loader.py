"""Compare a dataset with what lerobot's own loader reads; the only import of lerobot in this room."""

import json
import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from astra_data.core.optional import optional
from astra_data.dataset.columns import ACTION, EPISODE_INDEX, Array
from astra_data.dataset.doctor.check import Report
from astra_data.dataset.format import INFO_PATH
from astra_data.dataset.parquet import read_blocks
from astra_data.dataset.plain import PlainColumn, data_files, plain_columns, runs

WINDOWS = 32
"""Number of windows compared, spread evenly over the dataset."""
OFFSETS = np.array([-2, -1, 0, 1])
"""Steps of a window, relative to its row."""


@contextmanager
def _unchanged_logging() -> Iterator[None]:
    """Remove the handlers that the block adds to the root logger, which put a prefix before our messages."""
    root = logging.getLogger()
    before = list(root.handlers)
    try:
        yield
    finally:
        root.handlers[:] = before


@_unchanged_logging()
def compare_with_lerobot(root: Path, report: Report) -> None:
    """Open the dataset with `LeRobotDataset` and compare windows of observations and actions with the files.

    Works offline and leaves no cache behind; importing lerobot takes seconds and 0.8 GB.
    """
    os.environ["HF_HUB_OFFLINE"] = "1"
    optional("lerobot")
    import datasets.config  # noqa: PLC0415 - slow, and only after the environment is set
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: PLC0415

    info = json.loads((root / INFO_PATH).read_text(encoding="utf-8"))
    columns = [c for c in plain_columns(info["features"])[0] if c.name.startswith(("observation", ACTION))]
    deltas = {column.name: (OFFSETS / info["fps"]).tolist() for column in columns}
    cache, usual = tempfile.TemporaryDirectory(), datasets.config.HF_DATASETS_CACHE
    datasets.config.HF_DATASETS_CACHE = Path(cache.name)
    try:
        loaded = LeRobotDataset("local/dataset", root=root, delta_timestamps=deltas, video_backend="pyav")
        if (len(loaded), loaded.num_episodes) != (report.frames, report.episodes):
            found = f"{loaded.num_episodes} episodes, {len(loaded)} frames"
            report.fault("lerobot", f"lerobot sees {found}, not {report.episodes}, {report.frames}")
        for row, expected, padded in _windows(root, columns, report.frames):
            item = loaded[row]
            for name, values in expected.items():
                # Its loader makes float32 of floats alone.
                shown = values.astype(np.float32) if values.dtype.kind == "f" else values
                if not np.array_equal(item[name].numpy().reshape(values.shape), shown):
                    report.fault("lerobot", f"lerobot's window of {name} around row {row} has other values")
                if not np.array_equal(item[f"{name}_is_pad"].numpy(), padded):
                    report.fault("lerobot", f"lerobot's window of {name} around row {row} has other padding")
    except Exception as error:  # noqa: BLE001 - any failure of lerobot is a finding
        report.fault("lerobot", f"lerobot cannot open it: {type(error).__name__}: {error}".split("\n")[0])
    finally:
        datasets.config.HF_DATASETS_CACHE = usual
        cache.cleanup()


def _windows(
    root: Path, columns: list[PlainColumn], frames: int
) -> Iterator[tuple[int, dict[str, Array], Array]]:
    """Yield rows, the windows around them clipped to their episodes, and the mask of clipped steps."""
    wanted = set(np.linspace(0, frames - 1, WINDOWS).astype(int).tolist())
    read = [*columns, *(PlainColumn(name, "int64", 1) for name in (EPISODE_INDEX, "frame_index"))]
    first = 0
    for path in data_files(root):
        for run in runs(path, read_blocks([path], [column.name for column in read]), read):
            for row in sorted(wanted & set(range(first, first + len(run)))):
                steps = row - first + OFFSETS
                inside = np.clip(steps, 0, len(run) - 1)
                yield row, {c.name: run.columns[c.name][inside] for c in columns}, steps != inside
            first += len(run)
