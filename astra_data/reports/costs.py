"""Time and speed of all stages, from their artifacts."""

from collections.abc import Mapping, Sequence
from typing import Literal

from astra_data.reports.artifacts import Artifact
from astra_data.reports.schema import Cost

DATASET_STAGES = ("collect", "label", "augment", "pair", "subset")
"""Stages that write a dataset of each seed, in their order."""

THROUGHPUT = {
    **dict.fromkeys(DATASET_STAGES, ()),
    "collect": ("target_steps_per_second",),
    "pair": ("pairs_per_second",),
    "ground": ("windows_per_second", "episodes_per_second", "replays_per_second"),
    "train": ("simulator_steps_per_second", "steps_per_second", "updates_per_second"),
    "align": ("windows_per_second",),
    "select": (),
    "evaluate": ("target_steps_per_second",),
}
"""The keys under which each stage records its speed."""

Files = Mapping[str, Mapping[str, Sequence[Artifact]]]
"""Stage → row, shared grounding, or "all" → one artifact per seed."""


def seconds(files: Files, clock: Literal["wall_seconds", "cpu_seconds"]) -> dict[str, float]:
    """Return the time of each stage over all artifacts that record it, each counted once, and the "total"."""
    recorded = {
        stage: [spent for row in rows.values() for file in row if (spent := getattr(file, clock)) is not None]
        for stage, rows in files.items()
    }
    summed = {stage: sum(times) for stage, times in recorded.items() if times}
    return summed | {"total": sum(summed.values())}


def seed_cost(files: Mapping[str, Artifact]) -> dict[str, Cost]:
    """Return the cost by stage of what one seed is made of; a stage that recorded no time is left out."""
    return {
        stage: Cost(wall_seconds=file.wall_seconds, cpu_seconds=file.cpu_seconds)
        for stage, file in files.items()
        if file.wall_seconds is not None
    }


def with_first(cost: dict[str, Cost], first: Artifact | None) -> dict[str, Cost]:
    """Add to what a training costs, by stage, the training `first` from whose policy it starts, if any."""
    own = cost.get("train")
    if first is None or first.wall_seconds is None or own is None:
        return cost
    cpu_seconds = (
        None if own.cpu_seconds is None or first.cpu_seconds is None else own.cpu_seconds + first.cpu_seconds
    )
    wall_seconds = own.wall_seconds + first.wall_seconds
    return cost | {"train": Cost(wall_seconds=wall_seconds, cpu_seconds=cpu_seconds)}


def throughput(files: Files) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Return stage → figure → row → one value per seed."""
    return {stage: _stage_throughput(stage, rows) for stage, rows in files.items()}


def _stage_throughput(
    stage: str, files: Mapping[str, Sequence[Artifact]]
) -> dict[str, dict[str, list[float]]]:
    figures = {}
    for figure in THROUGHPUT[stage]:
        speeds = {method: [getattr(file, figure) for file in row] for method, row in files.items()}
        figures[figure] = {method: row for method, row in speeds.items() if row and None not in row}
    return figures
