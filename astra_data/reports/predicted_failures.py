"""The figures of predicted failures in results: what pages and the figure of reliability read."""

from typing import TYPE_CHECKING

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.grounding.failures import BINS
from astra_data.reports.results import WHOLE, Results

if TYPE_CHECKING:
    import pandas as pd


def predicted_failures(results: Results) -> "dict[tuple[int, str, str], pd.DataFrame]":
    """Return the figures of predicted failures by size, grounding and part of it: name → seed → value."""
    table = results.table
    of = table[(table["where"] == "ground") & table["measure"].str.startswith("failures.")]
    if of.empty:
        return {}
    names = of["measure"].str.split(".", n=2, expand=True)
    of = of.assign(part=names[1], measure=names[2])
    return {
        key: group.pivot_table(index="measure", columns="seed", values="value", sort=False)
        for key, group in of.groupby(["percent", "row", "part"], sort=False)
        if group["measure"].str.startswith("auc").any()
    }


def all_bins(of: "pd.DataFrame") -> Floats:
    """Return predicted and observed rates and number of steps of all bins and seeds, (N, 3)."""
    rows = of[of.index.str.startswith("reliability.")]
    bins = rows.groupby([name.split(".")[1] for name in rows.index], sort=False)
    found = [values.to_numpy().T for _, values in bins]
    stacked = np.concatenate(found) if found else np.empty((0, 3))
    return np.asarray(stacked[~np.isnan(stacked).any(axis=1)], dtype=np.float64)


def failure_rates(results: Results) -> dict[str, dict[str, Floats]]:
    """Return rates over all seeds at the largest size: what predicts failures → grounding → (3, bins).

    The three are predicted rate, observed rate and number of steps.
    """
    parts: dict[str, dict[str, Floats]] = {}
    for (percent, row, part), of in predicted_failures(results).items():
        rows = all_bins(of)
        if percent == (results.percents or [WHOLE])[-1] and len(rows):
            parts.setdefault(part.replace("_", " "), {})[row] = _pooled(rows)
    return parts


def _pooled(rows: Floats) -> Floats:
    """Pool rows (N, 3) of predicted and observed rates and numbers of steps by bin: (3, bins)."""
    bins = np.digitize(rows[:, 0], BINS[1:-1])
    steps = np.array([rows[bins == one, 2].sum() for one in np.unique(bins)])
    rates = [rows[bins == one, :2].T @ rows[bins == one, 2] for one in np.unique(bins)]
    return np.vstack([np.reshape(rates, (-1, 2)).T / steps, steps])
