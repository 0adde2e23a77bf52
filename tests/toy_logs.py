"""Logs of a toy robot without any fault, in which tests plant one."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from astra_data.dataset.columns import ACTION, NEXT_STATE, OUTCOME_COLUMNS, STATE, Array, Column, Episode
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter

FPS, EPISODES, STEPS = 20, 30, 100
_POSE = {"unit": ["m", "m", "rad"], "role": ["position", "position", "heading"]}
COLUMNS = (
    Column(STATE, size=3, names=("x", "y", "yaw"), astra=_POSE),
    Column(NEXT_STATE, size=3, names=("x", "y", "yaw"), astra=_POSE),
    Column(ACTION, size=2, names=("v", "w"), astra={"unit": ["m/s", "rad/s"]}),
    *OUTCOME_COLUMNS,
)
CLOCK = Column("time", "int64", astra={"unit": ["ns"]})

Columns = dict[str, Array]


def toy_columns(seed: int, steps: int = STEPS) -> Columns:
    """Drive [x, y, yaw] by commands [v, w], each held for 0.5 s; the time is in ns."""
    rng = np.random.default_rng(seed)
    drawn = rng.uniform([0.2, -1], [1, 1], (steps // 10 + 1, 2))
    command = drawn.repeat(10, axis=0)[:steps]
    yaw = np.cumsum(np.concatenate([[rng.uniform(-3, 3)], command[:, 1] / FPS]))
    moved = np.stack([np.cos(yaw[:-1]), np.sin(yaw[:-1])], axis=1) * command[:, :1] / FPS
    moved += rng.normal(0, 0.002, moved.shape)
    place = np.cumsum(np.concatenate([rng.uniform(-1, 1, (1, 2)), moved]), axis=0)
    wrapped = (yaw + np.pi) % (2 * np.pi) - np.pi
    state = np.column_stack([place, wrapped]).astype(np.float32)
    last = np.arange(steps) == steps - 1
    return {
        STATE: state[:-1].copy(),
        NEXT_STATE: state[1:].copy(),
        ACTION: command.astype(np.float32),
        "next.reward": rng.normal(1, 0.1, steps).astype(np.float32),
        "next.terminated": last & False,
        "next.truncated": last,
        "next.done": last,
        "next.success": last & False,
        "time": np.arange(steps, dtype=np.int64) * 10**9 // FPS,
    }


def write_logs(root: Path, alter: Callable[[int, Columns], Columns | None] | None = None) -> Dataset:
    """Write 30 episodes of 100 steps with times, each as `alter` leaves or returns it."""
    description = {"name": "logs", "stage": "import"}
    with DatasetWriter(root, [*COLUMNS, CLOCK], fps=FPS, task="drive", description=description) as writer:
        for uid in range(EPISODES):
            columns = toy_columns(uid)
            altered = alter(uid, columns) if alter else None
            writer.add(Episode(uid, altered or columns))
    return Dataset.open(root)
