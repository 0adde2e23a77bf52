"""Trials in the target that end a choice: successive halving from a prediction on, and what was tried."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, log2
from pathlib import Path

from pydantic import Field

from astra_data.reports.artifacts import Artifact, WrittenPart, read_json

TRIALS = "trials.json"
PSEUDO_TRIALS = 4
"""Trials that a prediction counts as: as a Beta prior it is then off by 0.2 or so, as predictions are."""
LEAST_TRIALS = 2
"""Of a candidate in a round: with one, chance decides; with more, fewer candidates are tried at all."""

Attempt = Callable[[int, tuple[int, ...], int], Sequence[int]]
"""Given a round's number, its candidates and the trials of each, returns how many of these succeeded."""


@dataclass(frozen=True)
class Halving:
    """What came of it.

    Attributes:
        rounds: the candidates of each round, and the trials of each of these.
        chosen: the candidate that is left. mean: of its success, given the prediction and all of its trials.
    """

    rounds: tuple[tuple[tuple[int, ...], int], ...]
    chosen: int
    mean: float


def least_trials(field: int) -> int:
    """Return how many trials are needed to halve so many candidates until one is left."""
    return 0 if field < 2 else LEAST_TRIALS * field + least_trials(ceil(field / 2))


def widest_field(candidates: int, trials: int) -> int:
    """Return how many of the candidates so many trials are enough for, at least 1."""
    return max(field for field in range(1, candidates + 1) if least_trials(field) <= trials)


def posterior(prior: float, successes: int, trials: int) -> float:
    """Return the mean of the Beta posterior of a success that was predicted as `prior`."""
    return (PSEUDO_TRIALS * prior + successes) / (PSEUDO_TRIALS + trials)


def halve(priors: Sequence[float], trials: int, attempt: Attempt, *, field: int | None = None) -> Halving:
    """Halve the candidates, by the posterior mean of their success, until one is left.

    Rounds share the trials equally, as do the candidates of a round. Ties go to what the prediction prefers.

    Args:
        priors: the predicted success of each candidate, the preferred first; not necessarily descending.
        trials: to spend at most; without any, the first is chosen.
        attempt: tries candidates.
        field: how many of the first are tried at all; by default as many as the trials are enough for.
    """
    left = tuple(range(widest_field(len(priors), trials) if field is None else field))
    spent, successes = [0] * len(priors), [0] * len(priors)
    rounds: list[tuple[tuple[int, ...], int]] = []

    def mean(one: int) -> float:
        return posterior(priors[one], successes[one], spent[one])

    while len(left) > 1:
        to_come = ceil(log2(len(left)))
        each = max(LEAST_TRIALS, trials // to_come // len(left))
        for one, count in zip(left, attempt(len(rounds), left, each), strict=True):
            spent[one] += each
            successes[one] += count
        trials -= each * len(left)
        rounds.append((left, each))
        left = tuple(sorted(left, key=lambda one: (-mean(one), one))[: ceil(len(left) / 2)])
    return Halving(tuple(rounds), left[0], mean(left[0]))


class Tried(WrittenPart):
    """A candidate in a round: 1 or 0 for each of its trials."""

    row: str
    seed: int
    success: list[int]


class TrialRound(WrittenPart):
    """A round. All of its candidates meet the same starts and goals."""

    trials: int
    """Of each candidate."""
    candidates: list[tuple[str, int]]
    """Row and seed of each, as the prediction prefers them."""
    tried: list[Tried] = Field(default_factory=list)
    """Those that are finished."""


class TrialsFile(Artifact):
    """trials.json: trials of candidates in the target."""

    trials: int
    """That may be spent."""
    field: int
    """Candidates of the first round."""
    percent: int | None = None
    """Their size of the dataset, if there are several."""
    pseudo_trials: int
    """What the prediction counts as."""
    rounds: list[TrialRound] = Field(default_factory=list)
    chosen: tuple[str, int] | None = None
    """Row and seed; None until all rounds are finished."""
    mean: float | None = None
    """Of its success, given the prediction and its trials."""

    @property
    def spent(self) -> int:
        """The trials that were made."""
        return sum(len(one.success) for round_ in self.rounds for one in round_.tried)


def read_trials(path: Path) -> TrialsFile | None:
    """Read trials.json; None if it is not there.

    Raises:
        BadInputError: it is malformed.
    """
    return read_json(TrialsFile, path) if path.is_file() else None
