"""Trials in the target that end a choice: what was tried in each round, and the lines that show it."""

from pathlib import Path

from pydantic import Field

from astra_data.reports.artifacts import Artifact, WrittenPart, read_json

TRIALS = "trials.json"


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
