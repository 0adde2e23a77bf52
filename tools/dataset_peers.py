"""The other ways to keep episodes: LeRobot's, Minari's, and HDF5 as robomimic lays it out."""

import shutil
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import minari
import numpy as np
import torch
from minari.data_collector import EpisodeBuffer

from astra_data.dataset.columns import ABSTRACT_STATE, ACTION, DONE, REWARD, STATE, Array, Column, Episode

COLUMNS = (
    Column(STATE, size=29),
    Column(ABSTRACT_STATE, size=4),
    Column(ACTION, size=2),
    Column(REWARD),
    Column(DONE, "bool"),
)
DRAWN = (STATE, ABSTRACT_STATE, ACTION, REWARD)
LENGTH = 32
BATCH = 256
FPS = 20


def frames_of(data: list[Episode]) -> int:
    """Return the number of frames of all episodes."""
    return sum(map(len, data))


def stacked(samples: list[list[Array]]) -> list[torch.Tensor]:
    """Make one batch out of samples."""
    return [torch.from_numpy(np.stack(values)) for values in zip(*samples, strict=True)]


class LeRobot:
    """lerobot's own writer, its loader on our dataset, and its DataLoader."""

    def __init__(self, modules: Any, root: Path) -> None:  # noqa: ANN401
        """Write to `root`."""
        self._modules = modules
        self._written = root / "lerobot"

    def write(self, data: list[Episode]) -> int:
        """Write frame by frame, as lerobot does."""
        shutil.rmtree(self._written, ignore_errors=True)
        features = {column.name: column.feature() | {"shape": (column.size,)} for column in COLUMNS}
        written = self._modules.LeRobotDataset.create(
            "a/b", FPS, features, root=self._written, use_videos=False, video_backend="pyav"
        )
        for episode in data:
            for frame in range(len(episode)):
                values = {name: np.atleast_1d(column[frame]) for name, column in episode.columns.items()}
                written.add_frame({**values, "task": "walk"})
            written.save_episode()
        written.finalize()
        return frames_of(data)

    def open(self, root: Path) -> None:
        """Read the dataset in `root`."""
        self._root = root
        self._table = self._dataset().hf_dataset.with_format("numpy").select_columns(list(DRAWN))

    def _dataset(self, **options: Any) -> Any:  # noqa: ANN401
        return self._modules.LeRobotDataset("a/b", root=self._root, video_backend="pyav", **options)

    def load(self) -> int:
        """Load all columns as numpy arrays."""
        return len(self._table[:][STATE])

    def loader(self, length: int) -> Any:  # noqa: ANN401
        """Return a DataLoader of windows, or of single frames."""
        deltas = {name: [step / FPS for step in range(length)] for name in DRAWN} if length > 1 else None
        dataset = self._dataset(delta_timestamps=deltas)
        return torch.utils.data.DataLoader(dataset, batch_size=BATCH, shuffle=True)


class Minari:
    """Minari's HDF5, with both states in one observation."""

    def __init__(self, root: Path) -> None:
        """Write below `root`, where the environment variable points."""
        self._folder = root / "minari" / "walks-v0"

    def write(self, data: list[Episode]) -> int:
        """Write all episodes."""
        shutil.rmtree(self._folder, ignore_errors=True)
        box = gymnasium.spaces.Box
        minari.create_dataset_from_buffers(
            "walks-v0",
            buffer=[_buffer(episode) for episode in data],
            observation_space=box(-np.inf, np.inf, (33,), np.float32),
            action_space=box(-np.inf, np.inf, (2,), np.float32),
            data_format="hdf5",
        )
        return frames_of(data)

    def open(self) -> None:
        """Open what was written."""
        self._dataset = minari.load_dataset("walks-v0")

    def load(self) -> int:
        """Iterate over the episodes."""
        return sum(len(episode.actions) for episode in self._dataset.iterate_episodes())

    def windows(self) -> int:
        """Sample episodes, and cut a window out of each."""
        rng = np.random.default_rng()
        cut = []
        for episode in self._dataset.sample_episodes(min(BATCH // 2, self._dataset.total_episodes)):
            first = rng.integers(len(episode.actions) - LENGTH)
            cut.append([a[first : first + LENGTH] for a in (episode.observations, episode.actions, episode.rewards)])
        return len(stacked(cut)[0])


def _buffer(episode: Episode) -> EpisodeBuffer:
    columns = episode.columns
    observations = np.concatenate([columns[STATE], columns[ABSTRACT_STATE]], axis=1)
    return EpisodeBuffer(
        id=episode.uid,
        observations=np.concatenate([observations, observations[-1:]]),
        actions=columns[ACTION],
        rewards=columns[REWARD],
        terminations=columns[DONE],
        truncations=columns[DONE],
        infos={},
    )


class Hdf5:
    """One group per episode, as robomimic lays it out; drawn from memory, as it does when it caches."""

    def __init__(self, root: Path) -> None:
        """Write below `root`."""
        self._path = root / "robomimic.hdf5"

    def write(self, data: list[Episode]) -> int:
        """Write all episodes, uncompressed."""
        with h5py.File(self._path, "w") as file:
            for episode in data:
                group = file.create_group(f"data/demo_{episode.uid}")
                for name, values in episode.columns.items():
                    group.create_dataset(name, data=values)
        return frames_of(data)

    def open(self) -> None:
        """Keep all episodes in memory."""
        self._episodes = self._read()

    def _read(self) -> list[dict[str, Array]]:
        with h5py.File(self._path) as file:
            return [{name: group[name][:] for name in DRAWN} for group in file["data"].values()]

    def load(self) -> int:
        """Read all episodes."""
        return sum(len(episode[STATE]) for episode in self._read())

    def windows(self) -> int:
        """Cut windows one by one and stack them."""
        return sum(self._batch(LENGTH) for _ in range(10))

    def transitions(self) -> int:
        """Take steps one by one and stack them."""
        return sum(self._batch(1) for _ in range(10))

    def _batch(self, length: int) -> int:
        rng = np.random.default_rng()
        cut = []
        for number in rng.integers(len(self._episodes), size=BATCH).tolist():
            episode = self._episodes[number]
            first = int(rng.integers(len(episode[STATE]) - length))
            cut.append([values[first : first + length] for values in episode.values()])
        return len(stacked(cut)[0])
