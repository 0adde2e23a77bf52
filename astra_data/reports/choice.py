"""The choice of a policy without the target: who was judged how, and what the choice is worth there."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
from pydantic import Field

from astra_data.reports.artifacts import Artifact, WrittenPart, read_json
from astra_data.reports.schema import Calibration, Choice, Ranked
from astra_data.reports.statistics import Correlation, mean_interval, mean_rank_correlation

FOLDER = "select"
SELECTED = "select.json"
LEAST = 3
"""Judges of a policy whose predicted success has an interval; seeds of a row whose ranks are compared."""
_QUANTILE = 0.25
"""Of the success over the judges, by which policies are ranked: one that a single judge likes is a risk."""

Measured = Mapping[tuple[str, int], float]
"""Row and seed → the success in the target."""


class Candidate(WrittenPart):
    """A trained policy, and its success with each judge."""

    row: str
    seed: int
    percent: int | None = None
    """Size of the dataset, if there are several."""
    success: dict[int, float] = Field(min_length=1)
    """Seed of the judge → share of the episodes."""

    @property
    def predicted(self) -> float:
        """The mean success over the judges."""
        return fmean(self.success.values())

    @property
    def lower(self) -> float:
        """The lower quartile of the success over the judges."""
        return float(np.quantile([*self.success.values()], _QUANTILE))

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval of `predicted`, None with fewer judges than `LEAST`.

        Judges are the sampling unit.
        """
        values = [*self.success.values()]
        return mean_interval(values) if len(values) >= LEAST else None


class Judged(Artifact):
    """select.json: all candidates of a recipe; nothing in it comes from the target."""

    judge: str
    """The method whose groundings judge."""
    episodes: int = Field(ge=1)
    """Of each candidate with each judge."""
    shares_episodes: bool = False
    """Whether the judges were fitted to the candidates' own episodes: all seeds have the same `data`."""
    candidates: list[Candidate] = Field(min_length=1)

    @property
    def percents(self) -> list[int | None]:
        """The sizes of the dataset, None alone where there are none."""
        return list(dict.fromkeys(one.percent for one in self.candidates))

    def ranked(self, percent: int | None = None) -> list[Candidate]:
        """Return the candidates of a size, best first: by the lower quartile, then by the mean."""
        those = [one for one in self.candidates if one.percent == percent]
        return sorted(those, key=lambda one: (one.lower, one.predicted), reverse=True)


def read_judged(root: Path) -> Judged | None:
    """Read what the stage `select` left in a run's folder; None if it was not run.

    Raises:
        BadInputError: it is malformed.
    """
    path = root / FOLDER / SELECTED
    return read_json(Judged, path) if path.is_file() else None


def choice_of(
    judged: Judged,
    percent: int | None,
    *,
    measured: Measured,
    rows: Sequence[str] = (),
    seeds: Sequence[int] = (),
    replicates: int,
) -> Choice | None:
    """Return the choice among the policies of some rows and seeds, by default all, and compare it.

    Args:
        judged: all candidates.
        percent: the size of the dataset, if there are several.
        measured: success in the target, as far as it is there; it has no say in the ranking.
        rows: of the candidates.
        seeds: of the candidates.
        replicates: bootstrap resamples.

    Returns:
        None if there is no candidate.
    """
    ranked = [
        _ranked(one, measured.get((one.row, one.seed)))
        for one in judged.ranked(percent)
        if (not rows or one.row in rows) and (not seeds or one.seed in seeds)
    ]
    if not ranked:
        return None
    withheld = {}
    if any(one.low is None for one in ranked):
        withheld["interval"] = f"fewer than {LEAST} judges"
    found = Choice(
        judge=judged.judge,
        episodes=judged.episodes,
        shares_episodes=judged.shares_episodes,
        candidates=ranked,
        withheld=withheld,
    )
    tested = [one for one in ranked if one.target is not None]
    return _compared(found, tested, replicates) if tested else found


def within_rows(tested: Sequence[Ranked], replicates: int) -> Correlation | None:
    """Correlate ranks within rows of `LEAST` tested seeds or more (Spearman): the mean over these rows.

    The interval resamples seeds, the same for all rows, since these share a seed's episodes. None if no row
    has enough seeds, or one side does not vary in any.
    """
    keys = [(one.lower, one.predicted) for one in tested]
    places = sorted(set(keys))
    rows: dict[str, dict[int, tuple[float, float]]] = {}
    for one, key in zip(tested, keys, strict=True):
        rows.setdefault(one.row, {})[one.seed] = (places.index(key), one.target or 0.0)
    return mean_rank_correlation(rows.values(), least=LEAST, replicates=replicates)


def _ranked(one: Candidate, target: float | None) -> Ranked:
    low, high = one.interval or (None, None)
    return Ranked(
        row=one.row,
        seed=one.seed,
        judges=len(one.success),
        lower=one.lower,
        predicted=one.predicted,
        low=low,
        high=high,
        target=target,
    )


def _compared(choice: Choice, tested: Sequence[Ranked], replicates: int) -> Choice:
    """Add what the choice is worth in the target, by the candidates that were tested there."""
    withheld = dict(choice.withheld)
    targets = [one.target for one in tested if one.target is not None]
    chosen = choice.candidates[0].target
    if chosen is None:
        withheld["regret"] = "the chosen policy was not tested in the target"
    correlation = within_rows(tested, replicates)
    if correlation is None:
        counts = [sum(one.row == row for one in tested) for row in {one.row for one in tested}]
        few = max(counts) < LEAST
        withheld["rank_correlation"] = (
            f"no row has {LEAST} tested seeds" if few else "in no row do both sides vary"
        )
    return choice.model_copy(
        update={
            "rank_correlation": correlation,
            "regret": None if chosen is None else max(targets) - chosen,
            "random_regret": max(targets) - fmean(targets),
            "calibration": {
                row: _calibration([one for one in tested if one.row == row])
                for row in dict.fromkeys(one.row for one in tested)
            },
            "withheld": withheld,
        }
    )


def _calibration(tested: Sequence[Ranked]) -> Calibration:
    errors = [one.predicted - one.target for one in tested if one.target is not None]
    return Calibration(
        seeds=len(errors), signed=fmean(errors), absolute=fmean(abs(error) for error in errors)
    )
