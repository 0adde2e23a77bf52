"""Which method to deploy, by a short rule, and the lines that the page and the terminal show of it.

The best method is the one with the highest mean score over seeds, references apart; two are compared on the seeds that
both have. It is deployed if it succeeds in half of the episodes or more (for scores without a limit: always), fails in
less than a third of them, and no floor does as well. Otherwise none is, for these reasons: a method did not learn to do
the task in the simulator of its training; what was learned there is lost in the target; the best fails too often.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from operator import gt
from pathlib import Path
from shlex import quote
from statistics import fmean
from typing import Any

import numpy as np

from astra_data.methods import grounded_as, method_named, method_role, method_title
from astra_data.reports.blocks import listed
from astra_data.reports.choice import Choice
from astra_data.reports.results import SIMULATED, Results, judged_horizon
from astra_data.reports.statistics import LEAST_SEEDS, Estimate, interval, paired_difference, summarize

ENOUGH = 0.5
"""Share of the largest possible score from which a method can be deployed, and has learned its own simulator; also the
R² of rewards on held-out episodes from which a grounding predicts them well."""
_TOO_MANY_FAILURES = 1 / 3  # share of episodes that end in a failure, such as a fall, from which nothing is deployed


@dataclass(frozen=True)
class Verdict:
    """What to deploy (`row` is None for none), with best method, floor and difference, and what limits the verdict."""

    row: str | None
    seed: int
    percent: int | None  # the size of its dataset, where the recipe sweeps over sizes
    text: str
    lines: list[tuple[str, str]]
    remarks: list[str]
    is_sensing: bool = False  # whether it acts on `[align] inputs`, which a deployed folder cannot

    def command(self, run: Path | str) -> str | None:
        """Return what deploys the policy of the run at `run`, a command or Python; None where none is to be."""
        if self.row is None:
            return None
        if self.is_sensing:
            return f"astra_data.load_policy({str(run)!r}, {self.row!r}, seed={self.seed}, percent={self.percent})"
        size = "" if self.percent is None else f" --percent {self.percent}"
        out = f"{Path(run).name}_{self.row}"
        return f"astra-data deploy {quote(str(run))} --row {self.row} --seed {self.seed}{size} --out {quote(out)}"


def verdict_of(results: Results) -> Verdict:
    """Return which method of results to deploy, at the largest size of the dataset."""
    percent, in_target = results.largest if results.sizes else None, results.tested_in == "target"
    scores = {row: found for row in results.tested() if (found := _scores(results, row))}
    worth = {row: summarize([*found.values()], **_bounds(results)) for row, found in scores.items()}
    rivals = {row: worth[row] for row in results.contenders() if row in worth}
    if not (best := _best(results, rivals)):
        return Verdict(None, 0, percent, "No method to deploy: all of them are references (floor or ceiling).", [], [])
    floor = _best(results, {row: found for row, found in worth.items() if method_role(row) == "floor"})
    title, score = method_title(best), _text(results, worth[best])
    lines = [("best", f"{title}: {score}"), ("interval", _difference(results, best, floor))]
    if floor:
        note = "what no correction of the simulator reaches"
        lines.insert(1, ("floor", f"{method_title(floor)} ({note}): {_text(results, worth[floor])}"))
    limit = results.headline.limit
    least = -np.inf if limit is None else ENOUGH * limit
    is_beaten = floor is not None and not gt(*_pair(results, best, floor)[1])
    learned = {row: results.score_of(row, SIMULATED) for row in rivals}
    poor = {row: found.value for row, found in learned.items() if found and found.value < least}
    poor = dict(sorted(poor.items(), key=lambda item: item[0] not in results.compare))
    causes = [_cause(results, row) for row in poor]
    chosen, advice = None, "Deploy" if in_target else "Try first"
    first = floor if floor and is_beaten else best
    failed = results.summary(first, "failed") if in_target and limit is not None else None
    tried = None if in_target else results.trials
    if tried and tried.choice and tried.rate and tried.percent in (None, results.largest):
        chosen = tried.chosen[0] if tried.chosen and tried.rate[0] >= ENOUGH else None
        text = f"{'Deploy' if chosen else 'Deploy none yet; best in trials is'} {tried.choice}."
    elif worth[first].value < least:
        text = "{} did not learn its own simulator ({})"
        why = [text.format(method_title(row), results.headline.text(found)) for row, found in poor.items()]
        if not why:
            why, causes = [f"the best method, {title}, has {score}"], [*_lost(results, best)]
        text = f"**Deploy none yet**: {listed(why)}."
    elif failed and failed.value >= _TOO_MANY_FAILURES:
        text = f"**Deploy none yet**: {method_title(first)} fails in {100 * failed.value:.0f} % of its episodes."
    else:
        chosen, why_it = first, ", the floor: no method does better" if is_beaten else f": {score}"
        text = f"{advice} **{method_title(first)}**{why_it}."
    remarks = [*causes, *_limits(results, worth, best)]
    align = results.settings.get("align")
    is_sensing = bool(chosen and isinstance(align, dict) and align.get("inputs") and method_named(chosen).aligns)
    return Verdict(chosen, _seed(results, chosen) if chosen else 0, percent, text, lines, remarks, is_sensing)


def _judges(results: Results) -> Choice | None:
    """Return the choice whose predictions methods are compared by where no target tested them, if there is one."""
    return None if results.tested_in == "target" else results.choice()


def _scores(results: Results, row: str) -> dict[int, float]:
    """Return by what methods are compared, by seed: the score in the target, else the success that judges predict."""
    if judges := _judges(results):
        return {one.seed: one.predicted for one in judges.candidates if one.row == row}
    return results.values(row, results.headline.measure)


def _bounds(results: Results) -> dict[str, Any]:
    """Return the limit of these scores, and of how many episodes each is the share."""
    judges = _judges(results)
    return {"limit": 1.0, "trials": judges.judged.episodes} if judges else results.bounds(results.headline.measure)


def _pair(results: Results, row: str, other: str) -> tuple[list[int], list[float]]:
    """Return the seeds that both have, and the mean of each on these, or on all of its own where there are none."""
    sides = [_scores(results, one) for one in (row, other)]
    shared = [seed for seed in sides[0] if seed in sides[1]]
    return shared, [fmean(of[seed] for seed in shared or of) for of in sides]


def _best(results: Results, worth: Mapping[str, Estimate]) -> str | None:
    """Return the method with the highest mean, beside each of the others."""
    best: str | None = None
    for row in sorted(worth, key=lambda row: worth[row].value, reverse=True):
        best = row if best is None or gt(*_pair(results, row, best)[1]) else best
    return best


def _text(results: Results, found: Estimate) -> str:
    seeds = f"({found.seeds} seed{'s' if found.seeds > 1 else ''})"
    if _judges(results):
        return f"predicted success {interval(found)} {seeds}"
    headline = results.headline
    return f"{headline.title} {interval(found, headline.digits)} {results.where} {seeds}"


def _difference(results: Results, best: str, floor: str | None) -> str:
    if floor is None:
        return "no floor to compare with: expected `direct_transfer` among the finished methods"
    found = paired_difference(*(_scores(results, row) for row in (best, floor)), **_bounds(results))
    if found is None:
        return f"{method_title(best)} and {method_title(floor)} share no seed"
    value = interval(found, 2 if _judges(results) else results.headline.digits)
    text = f"{method_title(best)} less {method_title(floor)}: {value}"
    if found.low is None or found.high is None:
        return f"{text}, of too few seeds for an interval: run {LEAST_SEEDS} or more"
    return f"{text}, 95 %" + (": these seeds do not show a difference" if found.low <= 0 <= found.high else "")


def _cause(results: Results, row: str) -> str:
    """Return why a method did not learn its own simulator, and what helps."""
    explained = results.summary(grounded_as(row), "r2_reward", "ground")
    if explained and explained.value < ENOUGH:
        return (
            f"{method_title(row)}: its rewards are predicted poorly on held-out episodes (R² {explained.value:.2f}; 1 "
            "is perfect, 0 is no better than the mean). Record more episodes (`episodes` of `[collect]`, or more logs)."
        )
    return (
        f"{method_title(row)}: train it longer (`total_steps` of `[train]`), or look at its learning curve "
        "below for a training that collapsed."
    )


def _lost(results: Results, row: str) -> Iterator[str]:
    """Yield why what a method learned does not hold in the target, and what helps."""
    title, grounding = method_title(row), grounded_as(row)
    if learned := results.score_of(row, SIMULATED):
        score = results.headline.text(learned.value)
        yield f"{title} learned the simulator of its training ({score}), and loses it {results.where}."
    errors = results.mean_errors()["mean"]
    if grounding in errors.index.get_level_values("row"):
        of = errors.loc[grounding].unstack("simulator")
        at = of.xs(judged_horizon(of.index.get_level_values("horizon")), level="horizon")
        if worse := [f"`{quantity}`" for quantity in at.index[at["grounded"] >= at["raw"]]]:
            fault = f"on held-out episodes its correction is no better than none in {listed(worse)}"
            yield f"{title}: {fault}: record more episodes, or longer ones."


def _limits(results: Results, worth: Mapping[str, Estimate], best: str) -> Iterator[str]:
    """Yield what limits the comparison."""
    choice, seeds = results.choice(), _scores(results, best).keys()
    if results.trials and results.trials.choice:
        yield f"{results.trials.spent} trials in the target choose {results.trials.choice}."
    if len(seeds) < LEAST_SEEDS:
        yield f"Intervals are not shown: they need {LEAST_SEEDS} seeds, {method_title(best)} has {len(seeds)}."
    for row in worth:
        shared, means = _pair(results, best, row)
        is_compared = row in results.contenders() or method_role(row) == "floor"
        is_plain = len(shared) >= LEAST_SEEDS and worth[best].value >= worth[row].value
        if is_compared and not is_plain and _scores(results, row).keys() != seeds:
            on = f"on seed{'s' * (len(shared) > 1)} {listed([*map(str, shared)])}" if shared else "on other seeds"
            more = "" if len(shared) >= LEAST_SEEDS else f"; run the missing ones, to share {LEAST_SEEDS} or more"
            values = " and ".join(map("{:.4g}".format, means))
            yield f"{method_title(best)} and {method_title(row)} are compared {on}: {values}{more}."
    if choice and results.tested_in == "target" and choice.best.row != best:
        chosen = f"{choice.best.name}, with a predicted success of {choice.best.predicted:.2f}"
        yield f"Without the target, the judges (simulators that did not train a policy) choose {chosen}."
    if unjudged := [method_title(row) for row in results.contenders() if row not in worth]:
        yield f"Not judged, so not compared: {', '.join(unjudged)}."


def _seed(results: Results, row: str) -> int:
    """Return the seed whose policy to deploy: the one that trials in the target choose, judges prefer, or the best."""
    choice, scores = results.choice(), results.values(row, results.headline.measure)
    tried = results.trials
    if tried and tried.chosen and tried.chosen[0] == row and tried.percent in (None, results.largest):
        return tried.chosen[1]
    preferred = [one.seed for one in choice.candidates if one.row == row] if choice else []
    return preferred[0] if preferred else max(scores, key=lambda seed: scores[seed])
