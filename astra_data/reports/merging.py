"""Results of one recipe from several places → Results: what comes later replaces what came before."""

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.methods import method_title
from astra_data.reports.comparing import improvement, summarised, validity
from astra_data.reports.origins import Named, dataset_uses, merged_origins
from astra_data.reports.schema import Cost, Dataset, GapMeans, MethodResults, Results

PER_SEED = (
    *("success", "failed", "wall_contact", "steps", "returns", "distance"),
    *("simulated_success", "simulated_steps", "simulator_returns", "encoders", "learning"),
)
"""Fields of a row that are lists over its seeds, or mappings to such."""


def merge(
    sources: Sequence[Results], *, methods: Sequence[str], seeds: Sequence[int], replicates: int
) -> Results:
    """Return one Results of those `methods` and `seeds` that any of the `sources` has, compared anew.

    A source of which later ones have all rows and seeds is left out. Times are summed, so what else was made
    twice counts twice. A grounding's gap is that of the source that has most seeds of it.

    Raises:
        BadInputError: the sources differ in task, episodes, robot or data.
    """
    _check_alike(sources)
    sources = [
        source for number, source in enumerate(sources) if not _is_replaced(source, sources[number + 1 :])
    ]
    gaps = _gaps(sources)
    rows, uses = {}, {}
    for method in methods:
        row, named = _row(method, sources, seeds)
        if row is not None:
            gap = None if row.grounding is None else gaps[row.grounding]
            rows[method] = summarised(row.model_copy(update={"gap": gap}), replicates)
            uses[method] = named
    reported = {seed for row in rows.values() for seed in row.seeds}
    return sources[-1].model_copy(
        update={
            "origins": merged_origins(origin for source in sources for origin in source.origins),
            "wall_seconds": reduce(_sum, (source.wall_seconds for source in sources)),
            "cpu_seconds": reduce(_sum, (source.cpu_seconds for source in sources)),
            "datasets": _datasets(sources),
            "evaluated_with": dataset_uses(uses),
            "seeds": [seed for seed in seeds if seed in reported],
            "methods": rows,
            "unfinished": [method_title(method) for method in methods if method not in rows],
            "probability_of_improvement": improvement(rows, sources[-1].headline, replicates),
            "predictive_validity": validity(rows, replicates),
            "throughput": reduce(_sum, (source.throughput for source in sources)),
        }
    )


def _is_replaced(source: Results, later: Sequence[Results]) -> bool:
    again = {(method, seed) for other in later for method, row in other.methods.items() for seed in row.seeds}
    return all((method, seed) in again for method, row in source.methods.items() for seed in row.seeds)


def _check_alike(sources: Sequence[Results]) -> None:
    first, *others = sources
    for other in others:
        told = {
            "task": (first.task, other.task),
            "episodes per row and seed": (first.episodes, other.episodes),
            "scale of the legs": (first.leg_scale, other.leg_scale),
        }
        wrong = [f"{what}: {before} and {now}" for what, (before, now) in told.items() if before != now]
        if wrong:
            raise BadInputError(
                f"{first.recipe}: expected results to add that are made alike, got {'; '.join(wrong)}"
            )


def _datasets(sources: Sequence[Results]) -> list[Dataset]:
    datasets: dict[tuple[str, int], Dataset] = {}
    for one in (dataset for source in sources for dataset in source.datasets):
        known = datasets.setdefault((one.stage, one.seed), one)
        if known.content_hash != one.content_hash:
            raise BadInputError(
                f"{sources[0].recipe}: expected results to add that are made of the same data, got those of "
                f"{one.stage} seed {one.seed} with content {known.content_hash} and {one.content_hash}"
            )
    return [datasets[key] for key in sorted(datasets)]


def _row(
    method: str, sources: Sequence[Results], seeds: Sequence[int]
) -> tuple[MethodResults | None, list[Named]]:
    """Return a row of all sources, where one has it, and the datasets of its seeds."""
    having = [source for source in sources if method in source.methods]
    rows = [source.methods[method] for source in having]
    kept = [seed for seed in seeds if any(seed in row.seeds for row in rows)]
    if not kept:
        return None, []

    def over_seeds(values: Sequence[Any]) -> Any:  # noqa: ANN401 - lists, or mappings to lists
        """Return lists over `kept`, of what all sources have, from a list over each one's own seeds."""
        if any(value is None for value in values):
            return None
        if isinstance(values[0], Mapping):
            common = [key for key in values[0] if all(key in value for value in values)]
            return {key: over_seeds([value[key] for value in values]) for key in common}
        if not all(values):
            return []
        of_seed = {
            seed: one
            for row, value in zip(rows, values, strict=True)
            for seed, one in zip(row.seeds, value, strict=True)
        }
        return [of_seed[seed] for seed in kept]

    merged = {field: over_seeds([getattr(row, field) for row in rows]) for field in PER_SEED}
    merged["seeds"] = kept
    merged["grounding"] = next((row.grounding for row in rows if row.grounding), None)
    merged["cost"] = _mean_cost(rows)
    return rows[-1].model_copy(update=merged), over_seeds([_named(source, method) for source in having])


def _named(results: Results, method: str) -> list[Named]:
    use = next(use for use in results.evaluated_with if method in use.methods)
    return list(zip(use.versions, use.hashes, strict=True))


def _mean_cost(rows: Sequence[MethodResults]) -> dict[str, Cost]:
    """Return the mean over the seeds of all, of what each gives as a mean over its own."""
    merged = {}
    for stage in dict.fromkeys(stage for row in rows for stage in row.cost):
        timed = [row for row in rows if stage in row.cost]
        weights = [len(row.seeds) for row in timed]
        wall = [row.cost[stage].wall_seconds for row in timed]
        cpu = [spent for row in timed if (spent := row.cost[stage].cpu_seconds) is not None]
        merged[stage] = Cost(
            wall_seconds=float(np.average(wall, weights=weights)),
            cpu_seconds=float(np.average(cpu, weights=weights)) if len(cpu) == len(wall) else None,
        )
    return merged


def _gaps(sources: Sequence[Results]) -> dict[str, GapMeans]:
    gaps: dict[str, GapMeans] = {}
    for source in sources:
        for grounding, gap in source.gaps().items():
            known = gaps.get(grounding, gap)
            gaps[grounding] = known if len(known.seeds) > len(gap.seeds) else gap
    return gaps


def _sum(before: Any, now: Any) -> Any:  # noqa: ANN401 - numbers, lists, or mappings to such
    """Add numbers, append lists, and do so key by key in mappings."""
    if not isinstance(before, Mapping):
        return before + now
    return {**before, **now, **{key: _sum(before[key], now[key]) for key in before if key in now}}
