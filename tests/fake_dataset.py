"""Small datasets for tests."""

import io
import os
import signal
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from astra_data.core import durable
from astra_data.dataset import columns as keys
from astra_data.dataset.format import IMAGE
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter, StagedWriter

COLUMNS = (
    keys.Column(
        keys.STATE,
        size=3,
        names=("x", "y", "yaw"),
        meaning="pose",
        astra={"unit": ["m", "m", "rad"], "role": ["position", "position", "heading"]},
    ),
    keys.Column(keys.ACTION, size=2, names=("x", "y")),
    *keys.OUTCOME_COLUMNS,
    keys.Column("mode", "int64", meaning="which gait"),
)
NEXT = keys.Column(keys.NEXT_STATE, size=3)
DESCRIPTION: Mapping[str, Any] = {
    "name": "fake",
    "stage": "collect",
    "config": {"episodes": 5, "noise_m": 0.1},
    "seeds": {"collect": 0},
    "environment": {"id": "Fake-v0"},
}
SETTINGS: Mapping[str, Any] = {"columns": COLUMNS, "fps": 20, "task": "run", "description": DESCRIPTION}
LENGTHS = (7, 1, 12, 30, 5)
NAMES = (keys.STATE, keys.ACTION, keys.REWARD, keys.TERMINATED, "mode", keys.INDEX)
"""Columns that tests draw from."""


def fake_columns(length: int, seed: int) -> dict[str, keys.Array]:
    rng = np.random.default_rng(seed)
    last = np.arange(length) == length - 1
    state = rng.normal(size=(length, 3)).astype(np.float32)
    # A far-off coordinate with tiny spread: float32 sums of squares lose it altogether.
    state[:, 1] = 100.0 + 0.01 * state[:, 1]
    return {
        keys.STATE: state,
        keys.ACTION: rng.uniform(-1, 1, size=(length, 2)).astype(np.float32),
        keys.REWARD: rng.normal(size=length).astype(np.float32),
        keys.TERMINATED: last & bool(seed % 2),
        keys.TRUNCATED: last & (not seed % 2),
        keys.DONE: last,
        keys.SUCCESS: last & bool(seed % 2),
        "mode": rng.integers(-5, 2**40, size=length),
    }


def fake_episode(uid: int, length: int) -> keys.Episode:
    metadata: dict[str, float | int | bool | str] = {"success": bool(uid % 2), "return": 0.5 * uid}
    if uid % 3 == 0:
        metadata["source_episode"] = uid - 1
    return keys.Episode(uid, fake_columns(length, seed=uid), metadata)


def fake_episodes() -> list[keys.Episode]:
    return [fake_episode(uid, length) for uid, length in zip((13, 4, 2**53 + 1, 6, 0), LENGTHS, strict=True)]


def writer(root: Path, **changes: Any) -> DatasetWriter:
    return DatasetWriter(root, **{**SETTINGS, **changes})


def write_fake(root: Path, episodes: Iterable[keys.Episode] | None = None, **changes: Any) -> Dataset:
    with writer(root, **changes) as open_writer:
        for episode in fake_episodes() if episodes is None else episodes:
            open_writer.add(episode)
    return Dataset.open(root)


def write_transitions(root: Path, *, has_goal: bool = True) -> Dataset:
    """Five episodes in which every next state is the state of the next step."""
    extra = (NEXT, keys.Column(keys.GOAL, size=2)) if has_goal else (NEXT,)
    with writer(root, columns=[*COLUMNS, *extra]) as open_writer:
        for number, episode in enumerate(fake_episodes()):
            state = episode.columns[keys.STATE]
            added: dict[str, keys.Array] = {keys.NEXT_STATE: np.concatenate([state[1:], state[:1] + 1])}
            if has_goal:
                added[keys.GOAL] = np.full((len(episode), 2), number, np.float32)
            metadata = dict(episode.metadata) | ({"seed": 3} if number == 1 else {})
            open_writer.add(keys.Episode(episode.uid, {**episode.columns, **added}, metadata))
    return Dataset.open(root)


def staged_writer(root: Path, **changes: Any) -> StagedWriter:
    return StagedWriter(root, **{**SETTINGS, **changes})


def assert_same(found: Iterable[keys.Episode], expected: Iterable[keys.Episode]) -> None:
    """The episodes are those expected, in the same order."""
    for episode, other in zip(found, expected, strict=True):
        assert (episode.uid, episode.metadata) == (other.uid, other.metadata)
        assert episode.columns.keys() == other.columns.keys()
        for name, values in other.columns.items():
            np.testing.assert_array_equal(episode.columns[name], values)


def write_images(path: Path, camera: str, pictures: Iterable[Any]) -> Path:
    """Write a column of images."""
    rows = []
    for number, picture in enumerate(pictures):
        stored = io.BytesIO()
        Image.fromarray(picture).save(stored, "PNG")
        rows.append({"bytes": stored.getvalue(), "path": f"{number}.png"})
    pq.write_table(pa.table({camera: pa.array(rows, IMAGE)}), path)
    return path


def concatenated(name: str) -> keys.Array:
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
