"""Datasets recorded by lerobot itself: `python lerobot_recordings.py FOLDER A B` makes one folder per case.

arm      4 episodes of two tasks, with a camera, rewards, forces as float64; one has a single row
ant      3 episodes of a state and an action
blind    cameras and actions, without a state
merged   our datasets A and B, merged by lerobot's tools
killed   what `killed_lerobot` leaves behind
"""

import sys
from pathlib import Path
from typing import Any

import killed_lerobot
import numpy as np

JOINTS = ["shoulder", "elbow", "wrist"]
ARM: dict[str, Any] = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": {"motors": JOINTS}},
    "action": {"dtype": "float32", "shape": (2,), "names": ["lift", "turn"]},
    "force": {"dtype": "float64", "shape": (2,), "names": None},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    "observation.images.top": {"dtype": "image", "shape": (8, 8, 3), "names": ["height", "width", "channels"]},
}
ANT: dict[str, Any] = {
    "observation.state": {"dtype": "float32", "shape": (29,), "names": None},
    "action": {"dtype": "float32", "shape": (2,), "names": None},
}
BLIND = {name: ARM[name] for name in ("action", "observation.images.top")}
LENGTHS = {"arm": (6, 1, 9, 4), "ant": (60, 50, 40), "blind": (3,)}
TASKS = ("lift", "turn")
FPS = {"arm": 10, "ant": 20, "blind": 10}


def values(case: str, episode: int) -> dict[str, Any]:
    """The columns of an episode, (T,) or (T, size)."""
    rng, steps = np.random.default_rng([len(case), episode]), LENGTHS[case][episode]
    last = np.arange(steps) == steps - 1
    size = 3 if case == "arm" else 29
    return {
        "observation.state": rng.normal(size=(steps, size)).astype(np.float32),
        "action": rng.uniform(-1, 1, size=(steps, 2)).astype(np.float32),
        "force": rng.normal(size=(steps, 2)),
        "next.reward": rng.normal(size=steps).astype(np.float32),
        "next.done": last,
        "next.success": last & (episode != 2),
        "observation.images.top": np.full((1, 8, 8, 3), 9, np.uint8)
        * np.arange(steps, dtype=np.uint8)[:, None, None, None],
    }


def main(folder: Path, merged: list[Path]) -> None:
    from lerobot.datasets.aggregate import aggregate_datasets  # noqa: PLC0415 - takes seconds
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: PLC0415

    for case, features in {"arm": ARM, "ant": ANT, "blind": BLIND}.items():
        robot = "so101" if case == "arm" else None
        dataset = LeRobotDataset.create(
            "a/b", FPS[case], features, root=folder / case, robot_type=robot, use_videos=False
        )
        for episode in range(len(LENGTHS[case])):
            columns = values(case, episode)
            task = TASKS[episode % 2] if case == "arm" else TASKS[0]
            killed_lerobot.add_frames(dataset, {name: columns[name] for name in features}, task)
            dataset.save_episode()
        dataset.finalize()
    ids = [f"a/{number}" for number in range(len(merged))]
    aggregate_datasets(ids, "a/merged", roots=merged, aggr_root=folder / "merged")


if __name__ == "__main__":
    killed_lerobot.main(Path(sys.argv[1]) / "killed")  # first: a fork has none of the threads that a recording starts
    main(Path(sys.argv[1]), [Path(path) for path in sys.argv[2:]])
