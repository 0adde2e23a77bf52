"""Errors of open-loop predictions, per axis and horizon, and their summary."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.core.seeding import generator
from astra_data.studies.predictors import Predictor
from astra_data.studies.rollouts import predict
from astra_data.studies.sequences import Sequences, Stretch
from astra_data.studies.walking import AXES, BODY_AXES

MOST_STARTS = 4000
REPLICATES = 1000

Cell = dict[str, float | None]
"""Figures of an axis by name; None for what is not known."""


@dataclass(frozen=True)
class Starts:
    """The starting moments at which all models are tested.

    Attributes:
        stretch: histories, and the steps of the longest horizon, (N, ...).
        piece: index of the piece of each start, (N,). horizons: K, in steps.
    """

    stretch: Stretch
    piece: NDArray[np.int64]
    horizons: tuple[int, ...]

    @classmethod
    def of(cls, sequences: Sequences, history: int, horizons: Sequence[int]) -> "Starts":
        """Start at every row of `sequences` with a history before it; of too many, at `MOST_STARTS` evenly.

        Horizons that no start reaches are left out.

        Raises:
            BadInputError: nowhere do all steps of the shortest horizon, after a history, count.
        """
        sequence, step = sequences.starts(history, min(horizons))
        if len(step) == 0:
            raise BadInputError(
                f"expected {min(horizons)} control steps that count, after {history} of any kind, in a "
                "recording to test on, found none"
            )
        # In order of time, so that an even spacing covers every piece.
        order = torch.argsort(sequences.piece[sequence] * 10**6 + step, stable=True)
        order = order[torch.linspace(0, len(order) - 1, min(len(order), MOST_STARTS)).long()]
        sequence, step = sequence[order], step[order]
        stretch = sequences.stretches(sequence, step, history, max(horizons))
        all_count = stretch.all_count
        reached = tuple(horizon for horizon in horizons if all_count[:, horizon - 1].any())
        return cls(stretch, sequences.piece[sequence].numpy(), reached)

    @torch.no_grad()
    def squared_errors(self, model: Predictor) -> Tensor:
        """Return squared errors (N, K, E); NaN where a step before the horizon does not count."""
        stretch, chosen = self.stretch, [horizon - 1 for horizon in self.horizons]
        predicted, true = predict(model, stretch)[:, chosen], stretch.body.chained(stretch.motion)[:, chosen]
        errors = stretch.body.wrong(predicted, true, stretch.heading).square()
        return errors.masked_fill(~stretch.all_count[:, chosen, None], torch.nan)


def summary(
    squared: Mapping[str, Floats],
    piece: NDArray[np.int64],
    horizons_s: Sequence[float],
    axes: Sequence[str] = AXES,
    judged: Sequence[str] = BODY_AXES,
) -> dict[str, dict[str, dict[str, Cell]]]:
    """Summarize the errors of several models by model, horizon and axis.

    Args:
        squared: squared errors of each model, (seeds, N, K, E), at the same N starts; "raw" among them.
        piece: index of the piece of each start, (N,).
        horizons_s: the K horizons.
        axes: names of the E errors.
        judged: those that are averaged, the first of them.

    Returns:
        For each axis "rmse" with "low" and "high"; "less_than_raw", the reduction of RMSE relative to the raw
        simulator, with "_low" and "_high"; and "less_than_ridge" likewise, if ridge regression is among the
        models. The axis "mean" holds the means of these reductions over `judged`. A reduction of errors that
        are all 0, as those of a joint at rest, is None.
    """
    pieces, number = np.unique(piece, return_inverse=True)
    # The bootstrap resamples pieces: starts within a piece are not independent.
    rng = generator(0, "walk bootstrap")
    weight = rng.multinomial(len(pieces), np.full(len(pieces), 1 / len(pieces)), REPLICATES).astype(float)
    weight = np.vstack([np.ones(len(pieces)), weight])
    rmse = {name: _rmse(values.mean(0), number, weight) for name, values in squared.items()}
    references = [name for name in ("raw", "ridge") if name in rmse]
    found: dict[str, dict[str, dict[str, Cell]]] = {}
    for name, values in rmse.items():
        # The first replicate is the sample itself.
        less = {reference: 1 - _ratio(values, rmse[reference]) for reference in references}
        found[name] = {}
        for k, horizon in enumerate(horizons_s):
            rows: dict[str, Cell] = {}
            for a, axis in enumerate(axes):
                rows[axis] = _interval(values[:, k, a], "rmse", "low", "high")
                for reference in references:
                    rows[axis] |= _less(reference, less[reference][:, k, a])
            rows["mean"] = {}
            for reference in references:
                parts = less[reference][:, k, : len(judged)]
                rows["mean"] |= _less(reference, _ratio(np.nansum(parts, -1), np.isfinite(parts).sum(-1)))
            found[name][f"{horizon:.3g}"] = rows
    return found


def _rmse(squared: Floats, number: NDArray[np.intp], weight: Floats) -> Floats:
    """Return the root of the mean of `squared` (N, K, E) for each row of piece weights (R, P), (R, K, E)."""
    count, total = (
        np.stack([values[number == piece].sum(0) for piece in range(weight.shape[1])])
        for values in (np.isfinite(squared).astype(float), np.nan_to_num(squared))
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.tensordot(weight, total, 1) / np.tensordot(weight, count, 1)))


def _ratio(values: Floats, divisor: Floats | NDArray[np.int64]) -> Floats:
    """Return `values` / `divisor`; NaN where that is 0, as are the errors of a joint at rest."""
    return np.divide(values, divisor, out=np.full_like(values, np.nan), where=divisor > 0)


def _less(reference: str, values: Floats) -> Cell:
    name = f"less_than_{reference}"
    return _interval(values, name, f"{name}_low", f"{name}_high")


def _interval(values: Floats, *names: str) -> Cell:
    """Return the first of `values` and the ends of the 95 % interval of the others, under three `names`.

    None where the first is NaN: then all are.
    """
    if np.isnan(values[0]):
        return dict.fromkeys(names)
    low, high = np.nanquantile(values[1:], [0.025, 0.975])
    return {name: round(float(value), 5) for name, value in zip(names, (values[0], low, high), strict=True)}
