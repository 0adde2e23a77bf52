"""The choice of a policy without the target, what it is worth there, and trials in the target that end it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, log2
from statistics import fmean

import numpy as np
from pydantic import Field

from astra_data.core.artifact import GROWING
from astra_data.methods import method_title
from astra_data.reports.artifacts import Artifact, WrittenPart
from astra_data.reports.blocks import Section, TableBlock, Text, markdown
from astra_data.reports.statistics import LEAST_SEEDS, Estimate, interval, success_rate, summarize

FOLDER, SELECTED = "select", "select.json"
SHEET, TRIALS, PAGE = GROWING  # what a person fills in, the record of trials, and the page
PSEUDO_TRIALS = 4  # trials that a prediction counts as: as a Beta prior it is then off by 0.2 or so, as predictions are
LEAST_TRIALS = 2  # of a candidate in a round: with one, chance decides; with more, fewer candidates are tried at all
_QUANTILE = 0.25  # of the success over judges, for ranking policies: one that a single judge likes is a risk
Attempt = Callable[[int, tuple[int, ...], int], Sequence[int]]
"""Given a round's number, its candidates and the trials of each, returns how many of these succeeded."""


def least_trials(field: int) -> int:
    """Return how many trials are needed to halve so many candidates until one is left."""
    return 0 if field < 2 else LEAST_TRIALS * field + least_trials(ceil(field / 2))


def widest_field(candidates: int, trials: int) -> int:
    """Return how many of the candidates so many trials are enough for, at least 1."""
    return max(field for field in range(1, candidates + 1) if least_trials(field) <= trials)


def posterior(prior: float, successes: int, trials: int) -> float:
    """Return the mean of the Beta posterior of a success that was predicted as `prior`."""
    return (PSEUDO_TRIALS * prior + successes) / (PSEUDO_TRIALS + trials)


def halve(priors: Sequence[float], trials: int, attempt: Attempt, *, field: int | None = None) -> tuple[int, float]:
    """Halve the first `field` candidates in equal rounds, by the posterior mean of success; return the last, and it."""
    left = tuple(range(widest_field(len(priors), trials) if field is None else field))
    spent, successes = [0] * len(priors), [0] * len(priors)
    number = 0

    def mean(one: int) -> float:
        return posterior(priors[one], successes[one], spent[one])

    while len(left) > 1:
        to_come = ceil(log2(len(left)))
        each = max(LEAST_TRIALS, trials // to_come // len(left))
        for one, count in zip(left, attempt(number, left, each), strict=True):
            spent[one] += each
            successes[one] += count
        trials -= each * len(left)
        number += 1
        left = tuple(sorted(left, key=lambda one: (-mean(one), one))[: ceil(len(left) / 2)])
    return left[0], mean(left[0])


class Tried(WrittenPart):
    """A candidate in a round: 1 or 0 for each of its trials, and the success predicted of each, if it is."""

    row: str
    seed: int
    success: list[int]
    predicted: list[float] = Field(default_factory=list)


class TrialRound(WrittenPart):
    """A round of so many trials of each candidate (row and seed, best first), with the same starts and goals."""

    trials: int
    candidates: list[tuple[str, int]]
    predicted: list[list[float]] = Field(default_factory=list)  # of each candidate, from each start, if by hand
    tried: list[Tried] = Field(default_factory=list)


class Trials(WrittenPart):
    """trials.json: the `trials` that may be spent on `field` candidates in the target, their rounds, the one chosen."""

    trials: int
    field: int
    percent: int | None = None
    by_hand: bool = False  # whether a person made them
    pseudo_trials: int
    rounds: list[TrialRound] = Field(default_factory=list)
    chosen: tuple[str, int] | None = None
    mean: float | None = None
    rate: tuple[float, float, float] | None = None  # success of the chosen one, and the ends of its 95 % interval

    @property
    def spent(self) -> int:
        """The trials that were made."""
        return sum(len(one.success) for round_ in self.rounds for one in round_.tried)

    @property
    def choice(self) -> str:
        """The one chosen and its success, in words; empty while there is none."""
        if self.chosen is None or self.rate is None:
            return ""
        row, seed = self.chosen
        return f"**{method_title(row)}, seed {seed}**: success {interval(Estimate(*self.rate))}"


class Candidate(WrittenPart):
    """A trained policy, and its success with each judge."""

    row: str
    seed: int
    percent: int | None = None  # size of the dataset, if there are several
    success: dict[int, float] = Field(min_length=1)  # seed of the judge → share of the episodes

    @property
    def name(self) -> str:
        """What it is called on a page."""
        return f"{method_title(self.row)}, seed {self.seed}"

    @property
    def predicted(self) -> float:
        """The mean success over the judges."""
        return fmean(self.success.values())

    @property
    def lower(self) -> float:
        """The lower quartile of the success over the judges."""
        return float(np.quantile([*self.success.values()], _QUANTILE))


class Judgment(WrittenPart):
    """All candidates of a recipe; nothing in it comes from the target."""

    judge: str  # the method whose groundings judge
    episodes: int = Field(ge=1)  # of each candidate with each judge
    shares_episodes: bool = False  # whether judges were fitted to the same episodes: all seeds have the same `data`
    candidates: list[Candidate] = Field(min_length=1)

    @property
    def percents(self) -> list[int | None]:
        """The sizes of the dataset, None alone where there are none."""
        return list(dict.fromkeys(one.percent for one in self.candidates))

    def ranked(self, percent: int | None = None) -> list[Candidate]:
        """Return the candidates of a size, best first: by the lower quartile, then by the mean."""
        those = [one for one in self.candidates if one.percent == percent]
        return sorted(those, key=lambda one: (one.lower, one.predicted), reverse=True)

    def estimate(self, one: Candidate) -> Estimate:
        """Return the predicted success of a candidate, with its interval over the judges."""
        return summarize([*one.success.values()], limit=1.0, trials=self.episodes)


class Judged(Judgment, Artifact):
    """select.json: what the judges found, and where."""


@dataclass(frozen=True)
class Choice:
    """The choice among `candidates` (best first) without the target, and what it is worth there, as far as tested."""

    judged: Judgment
    candidates: Sequence[Candidate]
    measured: Mapping[tuple[str, int], float]

    @property
    def best(self) -> Candidate:
        """The one that is chosen."""
        return self.candidates[0]

    def target(self, one: Candidate) -> float | None:
        """Return the success of a candidate in the target; None where it was not tested there."""
        return self.measured.get((one.row, one.seed))

    @property
    def regret(self) -> float | None:
        """Success in the target of the best there, less that of the chosen; None where that is not tested."""
        chosen = self.target(self.best)
        return None if chosen is None else max(self.measured.values()) - chosen

    @property
    def random_regret(self) -> float | None:
        """The same of a policy drawn at random, on average; None where none is tested."""
        return max(self.measured.values()) - fmean(self.measured.values()) if self.measured else None

    @property
    def calibration(self) -> dict[str, tuple[int, float, float]]:
        """Row → seeds, mean and mean absolute error of the predicted success."""
        errors: dict[str, list[float]] = {}
        for one in self.candidates:
            if (found := self.target(one)) is not None:
                errors.setdefault(one.row, []).append(one.predicted - found)
        return {row: (len(of), fmean(of), fmean(map(abs, of))) for row, of in errors.items()}


def choice_of(judged: Judgment, percent: int | None, *, measured: Mapping[tuple[str, int], float]) -> Choice | None:
    """Return the choice among the policies of a size, None for the whole; None without a candidate."""
    ranked = judged.ranked(percent)
    tested = {key: measured[key] for one in ranked if (key := (one.row, one.seed)) in measured}
    return Choice(judged, ranked, tested) if ranked else None


def choice_blocks(choice: Choice, shown: int | None = None) -> list[Text | TableBlock]:
    """Return what a page says of a choice, with the first `shown` of its candidates, by default all."""
    judged = choice.judged
    episodes = "the same episodes, from other seeds" if judged.shares_episodes else "the episodes of other seeds"
    lines = []
    for one in choice.candidates[:shown]:
        found = choice.target(one)
        cells = (method_title(one.row), f"{one.seed}", f"{one.lower:.2f}", interval(judged.estimate(one)))
        lines.append([*cells, f"{len(one.success)}", "-" if found is None else f"{found:.2f}"])
    head = ["method", "seed", "lower quartile", "predicted [95 %]", "judges", "in the target"]
    blocks: list[Text | TableBlock] = [
        Text(
            f"**{choice.best.name}**, chosen from {len(choice.candidates)} policies: predicted success "
            f"{interval(judged.estimate(choice.best))}."
        ),
        TableBlock("Best first, ranked by the lower quartile of success over judges", head, lines),
        Text(
            "A judge is a simulator that did not train the policy: a policy's judges are the groundings of "
            f"{method_title(judged.judge)} that were fitted to {episodes}, with {judged.episodes} episodes each. The "
            "judge's failure model ends episodes; if it has none, states are scattered as much as the target's. "
            f"Intervals need {LEAST_SEEDS} judges. The target is not used."
        ),
    ]
    if judged.shares_episodes:
        text = "All seeds of this run have the same episodes, so no judge is independent of the policies it judges: "
        blocks.append(Text(f"{text}an error that all groundings share goes unnoticed."))
    if choice.random_regret is not None:
        regret = "unknown (the chosen policy was not tested there)" if choice.regret is None else f"{choice.regret:.2f}"
        of_random = f"of a random policy: {choice.random_regret:.2f}."
        errors = [
            [method_title(row), f"{seeds}", f"{signed:+.2f}", f"{absolute:.2f}"]
            for row, (seeds, signed, absolute) in choice.calibration.items()
        ]
        head = ["method", "seeds", "predicted \N{MINUS SIGN} measured", "absolute error"]
        blocks.append(Text(f"Regret of the chosen policy, in success in the target: {regret}; {of_random}"))
        blocks.append(TableBlock("Error of the predicted success, means over seeds", head, errors))
    return blocks


def select_page(recipe: str, judged: Judgment, trials: Trials | None = None) -> str:
    """Return the page of all candidates, size by size, and of trials in the target where there are any."""
    sections = [
        Section(f"{percent} %" if percent else "", choice_blocks(choice))
        for percent in judged.percents
        if (choice := choice_of(judged, percent, measured={}))
    ]
    if trials:
        sections.append(Section("Trials in the target", trial_blocks(judged, trials)))
    return markdown(f"{recipe}: choice without the target", sections)


@dataclass(frozen=True)
class Standing:
    """A candidate after its trials so far: the posterior `mean` that ranks it, and its success `rate`."""

    name: str
    mean: float
    rate: Estimate


def standings(judged: Judgment, percent: int | None, rounds: Sequence[TrialRound]) -> dict[tuple[str, int], Standing]:
    """Return where all that were tried in the last of `rounds` stand after it, the best predicted first."""
    found = {}
    for one in judged.ranked(percent):
        key = (one.row, one.seed)
        tried = [of for round_ in rounds for of in round_.tried if (of.row, of.seed) == key]
        success, predicted = [n for of in tried for n in of.success], [n for of in tried for n in of.predicted]
        if success and key in rounds[-1].candidates:
            rate = success_rate(success, predicted, one.predicted, judged.episodes * len(one.success))
            mean = posterior(one.lower, sum(success), len(success))
            found[key] = Standing(one.name, mean, rate)
    return found


def advice(judged: Judgment, trials: Trials) -> str:
    """Return in a sentence who is ahead by how much, and whether more trials could change that."""
    if not trials.spent:
        return "Nothing is tried yet."
    found = standings(judged, trials.percent, trials.rounds)
    first, *others = sorted(found.values(), key=lambda one: -one.mean)
    text = f"{first.name} is ahead, with a success of {interval(first.rate)}"
    if len(found) < len(trials.rounds[-1].candidates):
        return f"{text}; others of this round are still to be tried."
    rival = max(others, key=lambda one: one.rate.high or 0.0)
    if (first.rate.low or 0.0) > (rival.rate.high or 0.0):
        return f"{text}. You can stop: all others of this round are below, at {rival.rate.high:.2f} or less."
    go_on = ": go on" if trials.spent < trials.trials else ""
    return f"{text}. {rival.name}, with {interval(rival.rate)}, may be as good{go_on}."


def trial_blocks(judged: Judgment, trials: Trials) -> list[Text | TableBlock]:
    """Return what a page says of trials in the target: how they end, and where each candidate stood by round."""
    lines = list[list[str]]()
    for number, round_ in enumerate(trials.rounds, start=1):
        found = standings(judged, trials.percent, trials.rounds[:number])
        for one in round_.tried:
            if stands := found.get((one.row, one.seed)):
                cells = (f"{number}", method_title(one.row), f"{one.seed}", f"{sum(one.success)}")
                lines.append([*cells, f"{len(one.success)}", f"{stands.mean:.2f}", interval(stands.rate)])
    choice = trials.choice
    state = f"{choice}." if choice else f"Not finished: run the same command again. {advice(judged, trials)}"
    size = f" at {trials.percent} %" if trials.percent else ""
    narrower = " that predictions of the same trials make narrower (control variate)" if trials.by_hand else ""
    return [
        Text(
            f"{state} {trials.spent} of {trials.trials} episodes were used, on the {trials.field} candidates "
            f"that the prediction ranks highest{size}."
        ),
        TableBlock("", ["round", "method", "seed", "succeeded", "of", "mean", "success [95 %]"], lines, words=2),
        Text(
            "Trials are split equally over rounds, and within a round over its candidates, which get the same starts "
            "and goals. After each round, the better half goes on. Mean: mean success over all trials of a candidate "
            f"so far, with the judges' lower quartile as a prior worth {trials.pseudo_trials} trials. Success: rate "
            f"over the same trials, with Wilson's interval{narrower}."
        ),
    ]
