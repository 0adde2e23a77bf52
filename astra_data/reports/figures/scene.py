"""What figures are drawn from besides the results: the task, and the folder of runs."""

from dataclasses import dataclass
from pathlib import Path

from astra_data.core.naming import artifact_key
from astra_data.reports.artifacts import TRAJECTORIES
from astra_data.reports.results import Results
from astra_data.worlds.task import Task


@dataclass(frozen=True)
class Scene:
    """Where figures find what is no number.

    Attributes:
        root: the recipe's folder of runs.
        task: the recipe's.
        methods: whose trajectories are drawn; all methods if none of these is in the results.
        episodes: how many of each.
    """

    root: Path
    task: Task
    methods: tuple[str, ...] = ()
    episodes: int = 12

    def folders(self, results: Results) -> dict[str, Path]:
        """Return method → evaluation of its first seed with trajectories; empty if any method has none."""
        rows = [row for row in self.methods if row in results.tested()] or results.tested()
        found = {}
        for row in rows:
            folders = (self.root / artifact_key("evaluate", row, seed) for seed in results.seeds)
            folder = next((folder for folder in folders if (folder / TRAJECTORIES).exists()), None)
            if folder is None:
                return {}
            found[row] = folder
        return found
