"""Results of one recipe from several places → Results: a later seed of a row replaces an earlier one."""

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

from astra_data.core.errors import BadInputError
from astra_data.methods import method_title
from astra_data.reports.comparing import improvement, summarized, validity
from astra_data.reports.mean_bands import mean_band
from astra_data.reports.origins import dataset_uses, merged_origins
from astra_data.reports.schema import BandMeans, DatasetOrigin, GapMeans, Results, shared_horizons
from astra_data.reports.seed_table import lines_of, row_of


def merge(
    sources: Sequence[Results],
    *,
    methods: Sequence[str],
    seeds: Sequence[int],
    replicates: int,
    compare: Sequence[str],
) -> Results:
    """Return one Results of those `methods` and `seeds` that any of the `sources` has, compared anew.

    A source of which later ones have all rows and seeds is left out. Times are summed, so other artifacts
    that were made twice count twice. A grounding's gap is the mean over the seeds of all sources; where they
    share seeds, of the source with most of them.

    Raises:
        BadInputError: the sources differ in task, episodes, robot or data.
    """
    _check_alike(sources)
    sources = _not_replaced(sources)
    table = {(line.method, line.seed): line for source in sources for line in lines_of(source)}
    by_method = {
        method: [table[method, seed] for seed in seeds if (method, seed) in table] for method in methods
    }
    finished = {method: lines for method, lines in by_method.items() if lines}
    gaps = _gaps(sources)
    rows = {method: summarized(row_of(lines, gaps), replicates) for method, lines in finished.items()}
    reported = {line.seed for lines in finished.values() for line in lines}
    return sources[-1].model_copy(
        update={
            "origins": merged_origins(origin for source in sources for origin in source.origins),
            "own_code": {name: digest for source in sources for name, digest in source.own_code.items()},
            "wall_seconds": reduce(_sum, (source.wall_seconds for source in sources)),
            "cpu_seconds": reduce(_sum, (source.cpu_seconds for source in sources)),
            "datasets": _datasets(sources),
            "evaluated_with": dataset_uses(
                {method: [line.dataset for line in lines] for method, lines in finished.items()}
            ),
            "seeds": [seed for seed in seeds if seed in reported],
            "methods": rows,
            "unfinished": [method_title(method) for method in methods if method not in rows],
            "probability_of_improvement": improvement(rows, sources[-1].headline, replicates, compare),
            "predictive_validity": validity(rows, replicates) if sources[-1].tested_in == "target" else {},
            "throughput": reduce(_sum, (source.throughput for source in sources)),
        }
    )


def _not_replaced(sources: Sequence[Results]) -> list[Results]:
    """Leave out the sources of which later ones have all rows and seeds."""
    kept: list[Results] = []
    later: set[tuple[str, int]] = set()
    for source in reversed(sources):
        own = {(method, seed) for method, row in source.methods.items() for seed in row.seeds}
        if not own <= later:
            kept.insert(0, source)
        later |= own
    return kept


def _check_alike(sources: Sequence[Results]) -> None:
    first, *others = sources
    for other in others:
        compared = {
            "task": (first.task, other.task),
            "episodes per row and seed": (first.episodes, other.episodes),
            "place of the tests": (first.tested_in, other.tested_in),
            "scale of the legs": (first.leg_scale, other.leg_scale),
        }
        wrong = [f"{what}: {before} and {now}" for what, (before, now) in compared.items() if before != now]
        if wrong:
            raise BadInputError(
                f"{first.recipe}: expected all merged results to be made alike, got {'; '.join(wrong)}"
            )


def _datasets(sources: Sequence[Results]) -> list[DatasetOrigin]:
    datasets: dict[tuple[str, int], DatasetOrigin] = {}
    for one in (dataset for source in sources for dataset in source.datasets):
        known = datasets.setdefault((one.stage, one.seed), one)
        if known.content_hash != one.content_hash:
            raise BadInputError(
                f"{sources[0].recipe}: expected all merged results to use the same data, got those of "
                f"{one.stage} seed {one.seed} with content {known.content_hash} and {one.content_hash}"
            )
    return [datasets[key] for key in sorted(datasets)]


def _gaps(sources: Sequence[Results]) -> dict[str, GapMeans]:
    gaps: dict[str, GapMeans] = {}
    for source in sources:
        for grounding, gap in source.gaps().items():
            gaps[grounding] = _joined(gaps[grounding], gap) if grounding in gaps else gap
    return gaps


def _joined(known: GapMeans, found: GapMeans) -> GapMeans:
    """Return the mean over the seeds of both; of the one with more seeds, where they cannot be averaged."""
    shared = shared_horizons([known.horizons, found.horizons])
    alike = known.grounded.keys() == found.grounded.keys()
    if not (shared and alike) or set(known.seeds) & set(found.seeds):
        return known if len(known.seeds) > len(found.seeds) else found

    places = [[gap.horizons.index(horizon) for horizon in shared] for gap in (known, found)]
    weights = [len(known.seeds), len(found.seeds)]

    def mean(one: Mapping[str, BandMeans], other: Mapping[str, BandMeans]) -> dict[str, BandMeans]:
        return {name: mean_band([one[name], other[name]], places, weights) for name in one}

    return GapMeans(
        seeds=sorted([*known.seeds, *found.seeds]),
        horizons=shared,
        grounded=mean(known.grounded, found.grounded),
        raw=mean(known.raw, found.raw),
        still=mean(known.still, found.still) if known.still and found.still else None,
    )


def _sum(before: Any, now: Any) -> Any:  # noqa: ANN401 - numbers, lists, or mappings to such
    """Add numbers, append lists, and do so key by key in mappings."""
    if not isinstance(before, Mapping):
        return before + now
    return {**before, **now, **{key: _sum(before[key], now[key]) for key in before if key in now}}
