"""Results as a tidy table: one line per row and seed, grouped into rows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from astra_data.methods import method_role, method_title
from astra_data.reports.schema import Cost, GapMeans, MethodResults, Results

Named = tuple[str | None, str | None]
"""Version and hash of the dataset that an evaluation names."""

PER_SEED = (
    *("success", "failed", "wall_contact", "steps", "returns", "distance"),
    *("simulated_success", "simulated_steps", "tries", "beyond_recorded"),
    *("simulator_returns", "encoders", "learning"),
)
"""Fields of `MethodResults` that are lists over its seeds, or mappings to such lists."""


@dataclass(frozen=True)
class Line:
    """One seed of one row.

    Attributes:
        method: name of the row.
        seed: its number.
        values: of each field in `PER_SEED`; None where the seed has none.
        grounding: folder of the row's groundings.
        cost: by stage.
        dataset: that the evaluation names.
    """

    method: str
    seed: int
    values: Mapping[str, Any]
    grounding: str | None
    cost: Mapping[str, Cost]
    dataset: Named


def lines_of(results: Results) -> list[Line]:
    """Return the table of `results`; each seed has the mean cost of its row."""
    datasets = {
        method: list(zip(use.versions, use.hashes, strict=True))
        for use in results.evaluated_with
        for method in use.methods
    }
    return [
        Line(
            method=method,
            seed=seed,
            values={field: _at(getattr(row, field), number) for field in PER_SEED},
            grounding=row.grounding,
            cost=row.cost,
            dataset=datasets[method][number],
        )
        for method, row in results.methods.items()
        for number, seed in enumerate(row.seeds)
    ]


def row_of(lines: Sequence[Line], gaps: Mapping[str, GapMeans]) -> MethodResults:
    """Return the row of `lines`, at least one, all of one method; what a seed lacks, the row lacks.

    Costs are the exception: that of a stage is the mean over the seeds that have it.

    Args:
        lines: in the order of the row's seeds.
        gaps: of each grounding.
    """
    method = lines[0].method
    values = {field: _over([line.values[field] for line in lines]) for field in PER_SEED}
    grounding = next((line.grounding for line in lines if line.grounding), None)
    return MethodResults(
        title=method_title(method),
        role=method_role(method),
        seeds=[line.seed for line in lines],
        **values | {"learning": values["learning"] or []},
        grounding=grounding,
        gap=None if grounding is None else gaps[grounding],
        cost={
            stage: _mean([line.cost[stage] for line in lines if stage in line.cost])
            for stage in dict.fromkeys(stage for line in lines for stage in line.cost)
        },
    )


def _at(values: Any, number: int) -> Any:  # noqa: ANN401 - a list over seeds, or a mapping to such lists
    """Return the value of one seed, None where there is none of any."""
    if isinstance(values, Mapping):
        return {key: _at(of, number) for key, of in values.items()}
    return values[number] if values else None


def _over(values: Sequence[Any]) -> Any:  # noqa: ANN401 - values, or mappings to values
    """Undo `_at`: return lists over seeds of what all of them have."""
    if any(value is None for value in values):
        return None
    if isinstance(values[0], Mapping):
        common = [key for key in values[0] if all(key in value for value in values)]
        return {key: _over([value[key] for value in values]) for key in common}
    return list(values)


def _mean(costs: Sequence[Cost]) -> Cost:
    cpu_seconds = [cost.cpu_seconds for cost in costs if cost.cpu_seconds is not None]
    return Cost(
        wall_seconds=float(np.mean([cost.wall_seconds for cost in costs])),
        cpu_seconds=float(np.mean(cpu_seconds)) if len(cpu_seconds) == len(costs) else None,
    )
