"""Datasets whose lerobot writer was killed: `main` makes one folder per case.

whole      8 episodes, finalized
saved      25 episodes saved, killed before finalize: no file has a footer
buffered   3 episodes saved, killed in the fourth: meta/episodes was never written
resumed    5 episodes finalized, 3 more in a resumed session, killed
"""

import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from forks import forked

FEATURES: dict[str, Any] = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": ["x", "y", "yaw"]},
    "action": {"dtype": "float32", "shape": (2,), "names": None},
    "force": {"dtype": "float64", "shape": (2,), "names": None},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}
FPS = 10


def length(episode: int) -> int:
    return 3 + episode % 6


def task(episode: int) -> str:
    return ("walk", "run")[episode % 2]


def values(episode: int) -> dict[str, Any]:
    """The columns of an episode, (T,) or (T, size)."""
    rng, steps = np.random.default_rng(episode), length(episode)
    return {
        "observation.state": rng.normal(size=(steps, 3)).astype(np.float32),
        "action": rng.normal(size=(steps, 2)).astype(np.float32),
        "force": rng.normal(size=(steps, 2)),
        "next.reward": rng.normal(size=steps).astype(np.float32),
        "next.done": np.arange(steps) == steps - 1,
    }


def add_frames(dataset: Any, columns: dict[str, Any], task: str) -> None:
    for frame in range(len(columns["action"])):
        dataset.add_frame({name: np.atleast_1d(column[frame]) for name, column in columns.items()} | {"task": task})


def save(dataset: Any, episodes: range) -> None:
    for episode in episodes:
        add_frames(dataset, values(episode), task(episode))
        dataset.save_episode()


def main(folder: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: PLC0415 - takes seconds

    def record(name: str, finalized: int, later: int = 0) -> Any:
        dataset = LeRobotDataset.create("a/b", FPS, FEATURES, root=folder / name, use_videos=False)
        if finalized:
            save(dataset, range(finalized))
            dataset.finalize()
        if finalized and later:
            dataset = LeRobotDataset.resume("a/b", root=folder / name)
        save(dataset, range(finalized, finalized + later))
        if name == "buffered":
            add_frames(dataset, values(later), task(later))
        return dataset

    for case in (("whole", 8), ("saved", 0, 25), ("buffered", 0, 3), ("resumed", 5, 3)):
        # One import of lerobot for all: each case is a fork that kills itself.
        assert forked(partial(kill_oneself, partial(record, *case))) == -signal.SIGKILL


def kill_oneself(case: Callable[[], object]) -> None:
    _unfinished = case()  # kept: lerobot closes its files when the dataset is collected
    os.kill(os.getpid(), signal.SIGKILL)
