"""A report over the runs of `fake_runs`: what it is given, and the making of it."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
from fake_runs import FakeRecipe

from astra_data.reports.command_replay import CommandReplay
from astra_data.reports.files import FIGURES as ALL_FIGURES
from astra_data.stages.report import ReportConfig, report
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.score import SUCCESS

REPLAY = CommandReplay(
    np.arange(4, dtype=np.float64), np.zeros((4, 2)), np.zeros((4, 4)), np.zeros((2, 4, 4))
)

LASTING_FIGURES = {"steps", "return", "learning_steps"}
FIGURES = {*ALL_FIGURES} - LASTING_FIGURES - {"strips", "data_efficiency"}

CONFIG = ReportConfig(bootstrap_replicates=100, trajectory_episodes=2)


def task(**changes: object) -> SimpleNamespace:
    usual = {
        "name": "antmaze-u",
        "photograph": None,
        "maze": U_MAZE,
        "plane": object(),
        "ball_index": None,
        "facts": {},
    }
    objective = SimpleNamespace(scores=(SUCCESS,), action_size=2)
    return SimpleNamespace(**usual | {"objective": objective, "make_target": object()} | changes)


def images(folder: Path) -> set[str]:
    return {path.stem for path in folder.glob("*.png")}


def make(
    root: Path,
    publish: Path | None = None,
    recipe: FakeRecipe | None = None,
    add_to: Path | None = None,
    note: str = "best: Careful follower  success 1.00",
) -> None:
    notes: list[tuple[float, str]] = []
    report(
        recipe or FakeRecipe(),
        root=root,
        command="astra-data run recipes/antmaze_u.toml",
        publish=publish,
        add_to=add_to,
        progress=lambda fraction, note: notes.append((fraction, note)),
        config=CONFIG,
    )
    if recipe is None:
        assert notes[-1] == (1.0, note)
