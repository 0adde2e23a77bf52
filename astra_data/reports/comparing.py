"""Summaries of rows over their seeds, and comparisons between rows."""

from collections.abc import Mapping

import numpy as np

from astra_data.core.naming import PLUS, is_plus
from astra_data.reports.schema import MethodResults, Validity
from astra_data.reports.statistics import Comparison, correlation, probability_of_improvement, summarise
from astra_data.worlds.score import Score

SHARED_WORLDS = ("raw", "grounded")
"""Simulators in which all rows are tested."""


def summarised(row: MethodResults, replicates: int) -> MethodResults:
    """Return a row with the summary of each of its measures over the seeds that have it."""
    summary = {}
    for name, values in row.measures().items():
        known = np.array([value for value in values or () if not np.isnan(value)])
        if len(known):
            summary[name] = summarise(known, replicates=replicates)
    return row.model_copy(update={"summary": summary})


def improvement(
    rows: Mapping[str, MethodResults], score: Score, replicates: int
) -> dict[str, dict[str, Comparison]]:
    """Compare ASTRA with every row that is trained alike: with the [plus] settings, or without.

    Rows that are trained in no simulator have no [plus] settings and are compared with both.
    """
    scores = {method: np.array(row.measures()[score.measure]) for method, row in rows.items()}
    compared = {method: row for method, row in rows.items() if row.role in (None, "floor")}
    return {
        ours: {
            other: probability_of_improvement(scores[ours], scores[other], replicates=replicates)
            for other, row in compared.items()
            if other != ours and (is_plus(other) == is_plus(ours) or row.simulated_success is None)
        }
        for ours in ("astra", f"astra{PLUS}")
        if ours in rows
    }


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
