"""A report over the runs of `fake_runs`: what it is given, and the making of it."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
from fake_runs import FakeRecipe

from astra_data.pipeline.stages.report import ReportConfig, report
from astra_data.reports.results import Results, read_results
from astra_data.worlds.objective import SUCCESS
from astra_data.worlds.plane.mazes import U_MAZE

REPLAY = (np.arange(4, dtype=np.float64), np.zeros((4, 2)), np.zeros((4, 4)), np.zeros((2, 4, 4)))
FIGURES = {"success", "trajectories", "mismatch", "learning", "gap", "validity"}
CONFIG = ReportConfig(trajectory_episodes=2)
COMMAND = "astra-data run recipes/antmaze_u.toml"


def task(**changes: object) -> SimpleNamespace:
    usual: dict[str, object] = {
        "name": "antmaze-u",
        "photograph": None,
        "plane": U_MAZE,
        "ball_index": None,
        "facts": {},
        "timestep_s": 0.1,
    }
    objective = SimpleNamespace(scores=(SUCCESS,), action_size=2, horizon=100)
    return SimpleNamespace(**usual | {"objective": objective, "make_target": object()} | changes)


def images(folder: Path) -> set[str]:
    return {path.stem for path in folder.glob("*.png")}


def make(
    root: Path,
    publish: Path | None = None,
    recipe: FakeRecipe | None = None,
    published: tuple[Path, ...] = (),
    config: ReportConfig = CONFIG,
) -> Results:
    """Write the report, and return its results."""
    report(recipe or FakeRecipe(), root=root, command=COMMAND, publish=publish, published=published, config=config)
    return read_results(root / "report/results.json")
