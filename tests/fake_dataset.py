"""Small datasets for tests."""

import os
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core import durable
from astra_data.dataset.columns import (
    ACTION,
    DONE,
    OUTCOME_COLUMNS,
    REWARD,
    STATE,
    SUCCESS,
    TERMINATED,
    TRUNCATED,
    Array,
    Column,
    Episode,
)
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter, StagedWriter

COLUMNS = (
    Column(
        STATE,
        size=3,
        names=("x", "y", "yaw"),
        meaning="pose",
        astra={"unit": ["m", "m", "rad"], "role": ["position", "position", "heading"]},
    ),
    Column(ACTION, size=2, names=("x", "y")),
    *OUTCOME_COLUMNS,
    Column("mode", "int64", meaning="which gait"),
)
DESCRIPTION: Mapping[str, Any] = {
    "name": "fake",
    "stage": "collect",
    "config": {"episodes": 5, "noise_m": 0.1},
    "seeds": {"collect": 0},
    "environment": {"id": "Fake-v0"},
}
LENGTHS = (7, 1, 12, 30, 5)


def fake_columns(length: int, seed: int) -> dict[str, Array]:
    rng = np.random.default_rng(seed)
    last = np.arange(length) == length - 1
    state = rng.normal(size=(length, 3)).astype(np.float32)
    # A far-off coordinate with tiny spread: float32 sums of squares lose it altogether.
    state[:, 1] = 100.0 + 0.01 * state[:, 1]
    return {
        STATE: state,
        ACTION: rng.uniform(-1, 1, size=(length, 2)).astype(np.float32),
        REWARD: rng.normal(size=length).astype(np.float32),
        TERMINATED: last & bool(seed % 2),
        TRUNCATED: last & (not seed % 2),
        DONE: last,
        SUCCESS: last & bool(seed % 2),
        "mode": rng.integers(-5, 2**40, size=length),
    }


def fake_episode(uid: int, length: int) -> Episode:
    metadata: dict[str, float | int | bool | str] = {"success": bool(uid % 2), "return": 0.5 * uid}
    if uid % 3 == 0:
        metadata["source_episode"] = uid - 1
    return Episode(uid, fake_columns(length, seed=uid), metadata)


def fake_episodes() -> list[Episode]:
    return [fake_episode(uid, length) for uid, length in zip((13, 4, 2**53 + 1, 6, 0), LENGTHS, strict=True)]


def writer(root: Path, **changes: Any) -> DatasetWriter:
    settings: dict[str, Any] = {"columns": COLUMNS, "fps": 20, "task": "run", "description": DESCRIPTION}
    return DatasetWriter(root, **settings | changes)


def write_fake(root: Path, **changes: Any) -> Dataset:
    with writer(root, **changes) as open_writer:
        for episode in fake_episodes():
            open_writer.add(episode)
    return Dataset.open(root)


def staged_writer(root: Path, **changes: Any) -> StagedWriter:
    settings: dict[str, Any] = {"columns": COLUMNS, "fps": 20, "task": "run", "description": DESCRIPTION}
    return StagedWriter(root, **settings | changes)


def concatenated(name: str) -> Array:
    return np.concatenate([episode.columns[name] for episode in fake_episodes()])


def _die(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def write_and_be_killed(root: Path, moment: str) -> None:
    """Write a dataset, for a fork that is killed on the way."""
    if moment == "renaming":
        durable.os.replace = _die  # type: ignore[attr-defined]
    if moment == "validating":
        Dataset.verify = _die  # type: ignore[assignment, method-assign]
    with writer(root) as killed_writer:
        for fake in fake_episodes():
            killed_writer.add(fake)
        if moment == "adding":
            _die()
