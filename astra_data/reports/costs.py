"""What the artefacts of all stages took, and how fast they were made."""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from astra_data.methods import METHODS
from astra_data.reports.artefacts import Artefact
from astra_data.reports.schema import Cost

THROUGHPUT = {
    "collect": ("target_steps_per_second",),
    "pair": ("pairs_per_second",),
    "ground": tuple(dict.fromkeys(rate for method in METHODS.values() for rate in method.fit_rates)),
    "train": tuple(dict.fromkeys(rate for method in METHODS.values() for rate in method.learn_rates)),
    "align": ("windows_per_second",),
    "evaluate": ("target_steps_per_second",),
}
"""The figures in which each stage gives its speed."""

Files = Mapping[str, Mapping[str, Sequence[Artefact]]]
"""Stage → row, or grounding that rows share, or "all" → one artefact per seed."""


def seconds(files: Files, clock: Literal["wall_seconds", "cpu_seconds"]) -> dict[str, float]:
    """Return the time of each stage over all artefacts that record it, each counted once, and the "total"."""
    recorded = {
        stage: [spent for row in rows.values() for file in row if (spent := getattr(file, clock)) is not None]
        for stage, rows in files.items()
    }
    summed = {stage: sum(times) for stage, times in recorded.items() if times}
    return summed | {"total": sum(summed.values())}


def row_cost(files: Mapping[str, Sequence[Artefact]]) -> dict[str, Cost]:
    """Return the mean cost of a seed by stage, for the stages whose `files` all record a time."""
    costs = {}
    for stage, of_seeds in files.items():
        wall, cpu = ([getattr(file, clock) for file in of_seeds] for clock in ("wall_seconds", "cpu_seconds"))
        if wall and None not in wall:
            costs[stage] = Cost(
                wall_seconds=float(np.mean(wall)),
                cpu_seconds=None if None in cpu else float(np.mean(cpu)),
            )
    return costs


def throughput(files: Files) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Return stage → figure → row → one value per seed."""
    return {stage: _stage_throughput(stage, rows) for stage, rows in files.items()}


def _stage_throughput(
    stage: str, files: Mapping[str, Sequence[Artefact]]
) -> dict[str, dict[str, list[float]]]:
    figures = {}
    for figure in THROUGHPUT[stage]:
        speeds = {method: [getattr(file, figure) for file in row] for method, row in files.items()}
        figures[figure] = {method: row for method, row in speeds.items() if row and None not in row}
    return figures
