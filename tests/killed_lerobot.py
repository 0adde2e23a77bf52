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


def add_frames(dataset: Any, episode: int) -> None:
    columns = values(episode)
    for frame in range(length(episode)):
        row = {name: np.atleast_1d(column[frame]) for name, column in columns.items()}
        dataset.add_frame({**row, "task": task(episode)})


def save(dataset: Any, episodes: range) -> None:
    for episode in episodes:
        add_frames(dataset, episode)
        dataset.save_episode()


def main(folder: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: PLC0415 - takes seconds

    def create(name: str) -> Any:
        return LeRobotDataset.create("a/b", FPS, FEATURES, root=folder / name, use_videos=False)

    def whole() -> Any:
        dataset = create("whole")
        save(dataset, range(8))
        dataset.finalize()
        return dataset

    def saved() -> Any:
        dataset = create("saved")
        save(dataset, range(25))
        return dataset

    def buffered() -> Any:
        dataset = create("buffered")
        save(dataset, range(3))
        add_frames(dataset, 3)
        return dataset

    def resumed() -> Any:
        dataset = create("resumed")
        save(dataset, range(5))
        dataset.finalize()
        dataset = LeRobotDataset.resume("a/b", root=folder / "resumed")
        save(dataset, range(5, 8))
        return dataset

    cases: tuple[Callable[[], Any], ...] = (whole, saved, buffered, resumed)
    for case in cases:
        # One import of lerobot for all: each case is a fork that kills itself.
        assert forked(partial(kill_oneself, case)) == -signal.SIGKILL


def kill_oneself(case: Callable[[], object]) -> None:
    _unfinished = case()  # kept: lerobot closes its files when the dataset is collected
    os.kill(os.getpid(), signal.SIGKILL)
