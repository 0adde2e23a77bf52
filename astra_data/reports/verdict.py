"""Which method to deploy, by a short rule, and the lines that the page and the terminal show of it.

The best method is the one with the highest mean score over seeds, references apart. It is deployed if it
succeeds in half of the episodes or more (for scores without a limit: always), and no floor does as well.
Otherwise none is, for the first of these reasons: a method did not learn to do the task in the simulator of
its training; what was learned there is lost in the target.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from astra_data.methods import grounded_as, method_role, method_title
from astra_data.reports.blocks import interval, listed
from astra_data.reports.results import JUDGED, SIMULATED, WHOLE, Results, contenders, judged_horizon
from astra_data.reports.statistics import LEAST_SEEDS, Summary, summarize

ENOUGH = 0.5
"""Share of the largest possible score from which a method can be deployed, and has learned its own
simulator."""
EXPLAINED = 0.5
"""R² of rewards on held-out episodes below which a grounding does not tell what its policies are rewarded
for."""


@dataclass(frozen=True)
class Verdict:
    """What to deploy.

    Attributes:
        row: the method; None where none is to be deployed.
        seed: of its policy. percent: size of its dataset.
        text: the verdict, in a sentence.
        lines: best method, floor, and the difference between them, each with its label.
        remarks: causes, what helps, and what limits the verdict.
    """

    row: str | None
    seed: int
    percent: int
    text: str
    lines: list[tuple[str, str]]
    remarks: list[str]

    def command(self, run: Path | str) -> str | None:
        """Return the command that deploys the policy of the run at `run`; None where none is to be."""
        if self.row is None:
            return None
        size = "" if self.percent == WHOLE else f" --percent {self.percent}"
        out = f"{Path(run).name}_{self.row}"
        return f"astra-data deploy {run} --row {self.row} --seed {self.seed}{size} --out {out}"


def verdict_of(results: Results) -> Verdict:
    """Return which method of results to deploy, at the largest size of the dataset."""
    percent = results.percents[-1]
    worth = {row: found for row in results.tested() if (found := _worth(results, row))}
    rivals = [row for row in contenders(results, percent) if row in worth]
    if not rivals:
        return Verdict(
            None, 0, percent, "No method to deploy: all of them are references (floor or ceiling).", [], []
        )
    best = max(rivals, key=lambda row: worth[row].mean)
    floors = [row for row in worth if method_role(row) == "floor"]
    floor = max(floors, key=lambda row: worth[row].mean, default=None)
    title, score = method_title(best), _text(results, worth[best])
    lines = [("best", f"{title}: {score}")]
    if floor:
        note = "what no correction of the simulator reaches"
        lines.append(("floor", f"{method_title(floor)} ({note}): {_text(results, worth[floor])}"))
    lines.append(("interval", _difference(results, best, floor, worth)))
    remarks = [*_limits(results, best, floor)]
    unlearned = [row for row in _in_order(results, rivals) if not _has_learned(results, row)]
    causes = [cause for row in unlearned for cause in _causes(results, row)]
    is_good = _share(results, worth[best]) >= ENOUGH
    chosen: str | None = best
    advice = "Deploy" if results.tested_in == "target" else "Try first"
    if floor and worth[floor].mean >= worth[best].mean and _share(results, worth[floor]) >= ENOUGH:
        chosen, text = floor, f"{advice} **{method_title(floor)}**, the floor: no method does better."
    elif is_good and not (floor and worth[floor].mean >= worth[best].mean):
        text = f"{advice} **{title}**: {score}."
    else:
        chosen = None
        why = [
            f"{method_title(row)} did not learn its own simulator ({_learned(results, row)})"
            for row in unlearned
        ]
        if not why:
            why = [f"the best method, {title}, has {score}"]
            causes = [*_lost(results, best)]
        text = f"**Deploy none yet**: {listed(why)}."
    seed = _seed(results, chosen) if chosen else 0
    return Verdict(chosen, seed, percent, text, lines, [*causes, *remarks])


def _worth(results: Results, row: str) -> Summary | None:
    """Return by what methods are compared: the score in the target, else the success that judges predict."""
    if results.tested_in == "target" or not results.judges:
        return results.score_of(row)
    line = [np.mean([*one.values.values()]) for one in results.lines if (one.row, one.where) == (row, JUDGED)]
    return summarize(np.array(line), limit=1.0, trials=results.judges.episodes) if line else None


def _text(results: Results, found: Summary) -> str:
    headline = results.headline
    is_predicted = results.tested_in != "target" and results.judges
    what = "predicted success" if is_predicted else headline.title
    value = interval(found.mean, found.low, found.high, 2 if is_predicted else headline.digits)
    place = "" if is_predicted else f" {results.where}"
    return f"{what} {value}{place} ({found.seeds} seed{'s' if found.seeds > 1 else ''})"


def _share(results: Results, found: Summary) -> float:
    """Return a score as a share of the largest possible one; 1 where there is no limit."""
    return found.mean / results.headline.limit if results.headline.limit else 1.0


def _difference(results: Results, best: str, floor: str | None, worth: dict[str, Summary]) -> str:
    if floor is None:
        return "no floor to compare with: add `direct_transfer` to `methods`"
    found = results.difference(best, floor)
    if found is None:
        return f"{method_title(best)} and {method_title(floor)} share no seed"
    digits = results.headline.digits
    value = interval(found.value, found.low, found.high, digits)
    text = f"{method_title(best)} less {method_title(floor)}: {value}"
    if found.low is None or found.high is None:
        return f"{text}, of too few seeds for an interval: run {LEAST_SEEDS} or more"
    return f"{text}, 95 %" + (
        ": these seeds do not show a difference" if found.low <= 0 <= found.high else ""
    )


def _in_order(results: Results, rows: list[str]) -> list[str]:
    """Return the methods that the results compare with the others first."""
    return sorted(rows, key=lambda row: row not in results.compare)


def _has_learned(results: Results, row: str) -> bool:
    found = results.score_of(row, SIMULATED)
    return found is None or _share(results, found) >= ENOUGH


def _learned(results: Results, row: str) -> str:
    found = results.score_of(row, SIMULATED)
    return results.headline.text(found.mean) if found else "-"


def _causes(results: Results, row: str) -> Iterator[str]:
    """Yield why a method did not learn its own simulator, and what helps."""
    title, grounding = method_title(row), grounded_as(row)
    explained = results.summary(grounding, "r2_reward", "ground")
    if explained and explained.mean < EXPLAINED:
        yield (
            f"{title}: its rewards are predicted poorly on held-out episodes (R² {explained.mean:.2f}; 1 is "
            "perfect, 0 is no better than the mean). Record more episodes (`episodes` of `[collect]`, or "
            "more logs)."
        )
        return
    yield (
        f"{title}: train it longer (`total_steps` of `[train]`), or look at its learning curve below for a "
        "training that collapsed."
    )


def _lost(results: Results, row: str) -> Iterator[str]:
    """Yield why what a method learned does not hold in the target, and what helps."""
    title, grounding = method_title(row), grounded_as(row)
    learned = results.score_of(row, SIMULATED)
    if learned:
        score = _learned(results, row)
        yield f"{title} learned the simulator of its training ({score}), and loses it {results.where}."
    errors = results.mean_errors()
    worse = []
    if grounding in errors.index.get_level_values("row"):
        of = errors.loc[grounding, "mean"].unstack("simulator")
        horizon = judged_horizon(of.index.get_level_values("horizon"))
        at = of.xs(horizon, level="horizon")
        worse = [f"`{quantity}`" for quantity in at.index if at["grounded"][quantity] >= at["raw"][quantity]]
    if worse:
        yield (
            f"{title}: on held-out episodes its correction is no better than none in {listed(worse)}: "
            "record more episodes, or longer ones."
        )
    failed = results.summary(row, "failed")
    if failed and failed.mean >= ENOUGH:
        yield f"{title} fails in {100 * failed.mean:.0f} % of its episodes: look at these first."


def _limits(results: Results, best: str, floor: str | None) -> Iterator[str]:
    """Yield what limits the comparison."""
    worth = results.score_of(best)
    if worth and worth.seeds < LEAST_SEEDS:
        count = f"{method_title(best)} has {worth.seeds}"
        yield f"Intervals are not shown: they need {LEAST_SEEDS} seeds, {count}."
    choice = results.choice()
    if choice and results.tested_in == "target" and choice.candidates[0].row != best:
        first = choice.candidates[0]
        yield (
            f"Without the target, the judges (simulators that did not train a policy) choose {first.name}, "
            f"with a predicted success of {first.predicted.value:.2f}."
        )
    unjudged = [row for row in contenders(results) if results.judges and not _is_judged(results, row)]
    if unjudged and results.tested_in != "target":
        yield f"Not judged, so not compared: {', '.join(map(method_title, unjudged))}."


def _is_judged(results: Results, row: str) -> bool:
    return any(line.row == row and line.where == JUDGED for line in results.lines)


def _seed(results: Results, row: str) -> int:
    """Return the seed whose policy to deploy: the one that judges prefer, else the best one."""
    choice = results.choice()
    if (
        choice
        and (preferred := next((one.seed for one in choice.candidates if one.row == row), None)) is not None
    ):
        return preferred
    scores = results.values(row, results.headline.measure)
    return max(scores, key=lambda seed: scores[seed])
