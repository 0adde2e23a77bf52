"""Summaries of rows over their seeds, and comparisons between rows."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from astra_data.core.naming import PLUS, is_plus
from astra_data.reports.schema import MethodResults, Validity
from astra_data.reports.statistics import (
    Comparison,
    Difference,
    correlation,
    paired_difference,
    probability_of_improvement,
    summarize,
)
from astra_data.worlds.score import Score

SHARED_WORLDS = ("raw", "grounded")
"""Simulators in which all rows are tested."""


def summarized(row: MethodResults, replicates: int) -> MethodResults:
    """Return a row with the summary of each of its measures over the seeds that have it."""
    summary = {}
    for name, values in row.measures().items():
        known = np.array([value for value in values or () if not np.isnan(value)])
        if len(known):
            summary[name] = summarize(known, replicates=replicates)
    return row.model_copy(update={"summary": summary})


def improvement(
    rows: Mapping[str, MethodResults], score: Score, replicates: int, methods: Sequence[str] = ("astra",)
) -> dict[str, dict[str, Comparison]]:
    """Compare the rows of `methods` with those that are trained alike: with the [plus] settings, or without.

    Rows that are trained in no simulator have no [plus] settings and are compared with both.
    """
    compared = {method: row for method, row in rows.items() if row.role in (None, "floor")}
    return {
        ours: {
            other: _compared(rows[ours], row, score, replicates)
            for other, row in compared.items()
            if other != ours and (is_plus(other) == is_plus(ours) or row.simulated_success is None)
        }
        for method in methods
        for ours in (method, f"{method}{PLUS}")
        if ours in rows
    }


def _compared(row: MethodResults, other: MethodResults, score: Score, replicates: int) -> Comparison:
    ours, theirs = (np.array(one.measures()[score.measure]) for one in (row, other))
    found = probability_of_improvement(ours, theirs, replicates=replicates)
    return replace(found, difference=_difference(row, other, score))


def _difference(row: MethodResults, other: MethodResults, score: Score) -> Difference | None:
    """Return the difference on the seeds that both have; None where these are fewer than two."""
    ours, theirs = (
        dict(zip(one.seeds, one.measures()[score.measure] or (), strict=True)) for one in (row, other)
    )
    shared = [seed for seed in ours if seed in theirs]
    if len(shared) < 2:
        return None
    return paired_difference(*(np.array([of[seed] for seed in shared]) for of in (ours, theirs)))


def validity(rows: Mapping[str, MethodResults], replicates: int) -> dict[str, Validity]:
    """Correlate the return in each shared simulator with that in the target, over rows and seeds."""
    found = {}
    for world in SHARED_WORLDS:
        tested = [row for row in rows.values() if world in row.simulator_returns]
        simulated = [np.array(row.simulator_returns[world]) for row in tested]
        target = [np.array(row.returns) for row in tested]
        if tested:
            found[world] = Validity(
                policies=sum(map(len, target)),
                pearson=correlation(simulated, target, replicates=replicates),
                spearman=correlation(simulated, target, ranks=True, replicates=replicates),
            )
    return found
