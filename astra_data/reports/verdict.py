"""Which row of results to deploy, in a sentence or two, and what stands beside that."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from statistics import fmean

from astra_data.reports.choice_page import named
from astra_data.reports.formatting import interval, spread
from astra_data.reports.schema import MethodResults, Ranked, Results
from astra_data.reports.statistics import share_interval
from astra_data.reports.tested import where
from astra_data.worlds.score import SUCCESS

_PERCENT = "\N{NO-BREAK SPACE}%"
_SURE = f"95{_PERCENT}"
_ENOUGH_SEEDS = 4
"""With fewer, an interval over seeds is no wider than the seeds lie apart."""
_MOSTLY = 0.5
"""A verdict warns where more episodes fail, or fewer succeed in the policy's own simulator."""


@dataclass(frozen=True)
class Fact:
    """A number beside the verdict.

    Attributes:
        label: what it is of.
        value: as text.
        note: its interval, and what it was measured on.
    """

    label: str
    value: str
    note: str


@dataclass(frozen=True)
class Verdict:
    """What to deploy.

    Attributes:
        row: name of the row; None where all rows are references.
        opening: what comes before the title in the verdict.
        title: of the row, with the seed of a chosen policy.
        reason: what comes behind it.
        remarks: what limits it.
        facts: the numbers that it rests on, and those of the references.
    """

    row: str | None
    opening: str
    title: str
    reason: str
    remarks: list[str]
    facts: list[Fact]


def verdict_of(results: Results, percent: int | None = None) -> Verdict:
    """Name the row to deploy: that of the chosen policy, or else the one with the best mean over seeds.

    A row with a role is a reference and not the one, unless a policy of the floor was chosen: then grounding
    gained nothing. Where nothing was tested in the target, rows are compared by what judges predict, if a
    policy was chosen: they foresee failures.

    Args:
        results: of all rows.
        percent: the size of the dataset, if there are several.
    """
    references = {name: _of_row(results, row) for name, row in results.methods.items() if row.role}
    if len(references) == len(results.methods):
        return Verdict(None, "No row to deploy: all rows are references.", "", "", [], [*references.values()])
    chosen = chosen_of(results)
    name = chosen.row if chosen else best_of(results)
    row = results.methods[name]
    references.pop(name, None)
    worth = _worth(results)
    as_good = [floor.title for key, floor in _floors(results) if worth.get(key, -inf) >= worth[name]]
    opening = "Deploy"
    if chosen and chosen.predicted == 0:
        opening = "Deploy none: all are predicted to fail. The first in the ranking is"
    elif row.role:
        opening = "No gain over the floor: the policy to deploy is"
    elif as_good:
        opening = (
            f"No gain over the floor: {' and '.join(as_good)} does as well or better. "
            "Of the other rows, deploy"
        )
    facts = [_of_row(results, row), *references.values()]
    remarks = [*_remarks(results, name, chosen)]
    if chosen:
        title, reason = named(chosen.row, chosen.seed), _why_chosen(results, chosen, percent)
        return Verdict(name, opening, title, reason, remarks, [*_of_choice(results, chosen), *facts])
    return Verdict(name, opening, row.title, _why_best(results, row, percent), remarks, facts)


def best_of(results: Results, otherwise: str = "") -> str:
    """Return the row with the best mean over seeds that is no reference; else `otherwise`."""
    worth = _worth(results)
    rivals = [name for name in worth if not results.methods[name].role]
    return max(rivals, key=lambda name: worth[name], default=otherwise)


def chosen_of(results: Results) -> Ranked | None:
    """Return the best candidate of `select` whose row is tested and no ceiling; None without one."""
    candidates = results.choice.candidates if results.choice else []
    return next((one for one in candidates if not _passed_over(results, one)), None)


def _passed_over(results: Results, one: Ranked) -> str:
    """Return why a candidate is not the one to deploy; empty if it may be."""
    row = results.methods.get(one.row)
    if row is None:
        return "has not been tested yet"
    return f"belongs to a reference row ({row.role})" if row.role not in (None, "floor") else ""


def _remarks(results: Results, name: str, chosen: Ranked | None) -> Iterator[str]:
    worth, is_predicted = _worth(results), _is_predicted(results)
    ahead = best_of(results, name)
    row, best = results.methods[name], results.methods[ahead]
    if chosen and results.choice:
        candidates = results.choice.candidates
        for one in candidates[: candidates.index(chosen)]:
            yield f"select ranks {named(one.row, one.seed)} higher, but it {_passed_over(results, one)}."
        level = sum((one.lower, one.predicted) == (chosen.lower, chosen.predicted) for one in candidates)
        if level > 1:
            yield f"{level} policies, including this one, tie in the ranking."
        if worth[ahead] > worth[name]:
            score = f"predicted success {worth[ahead]:.2f}" if is_predicted else _score(results, best)
            yield f"By the mean over seeds, {best.title} is ahead: {score}."
        if results.choice.regret and chosen is candidates[0]:
            yield (
                "In hindsight, another policy is better in the target by "
                f"{results.choice.regret:.2f}, the regret of the choice."
            )
        for figure, why in results.choice.withheld.items():
            yield f"Withheld for the choice: {figure.replace('_', ' ')} ({why})."
        if results.choice.shares_episodes:
            yield "All seeds have the same episodes, so no judge is independent of the policies it judges."
    else:
        ties = [
            of.title
            for of in results.methods.values()
            if of is not row and not of.role and _mean(results, of) == _mean(results, row)
        ]
        if ties:
            yield f"Equal by the mean: {', '.join(ties)}."
    for key, floor in _floors(results):
        if floor is row:
            continue
        if not is_predicted:
            yield from _against(results, row, floor)
        elif key in worth:
            yield f"Predicted success of {floor.title}: {worth[key]:.2f}, the mean over its seeds."
    if unjudged := [
        of.title for key, of in results.methods.items() if of.role != "ceiling" and key not in worth
    ]:
        yield f"Not judged, so not compared: {', '.join(unjudged)}."
    own = zip(row.seeds, row.simulated_success or (), strict=False) if results.headline == SUCCESS else ()
    reached = [success for seed, success in own if not chosen or seed == chosen.seed]
    if reached and fmean(reached) < _MOSTLY:
        yield (
            f"In the simulator of its training, it succeeds in {100 * fmean(reached):.0f}{_PERCENT} of the "
            "episodes: it did not learn to do the task there."
        )
    failed = row.summary["failed"].mean
    if failed >= _MOSTLY:
        yield (
            f"{row.title} fails in {100 * failed:.0f}{_PERCENT} of its episodes: "
            "look at these failures before you deploy it."
        )


def _against(results: Results, row: MethodResults, floor: MethodResults) -> Iterator[str]:
    """Yield a warning if the seeds do not show a difference to the floor."""
    measure = results.headline.measure
    ours, its = row.summary[measure], floor.summary[measure]
    if ours.low is None or ours.high is None or its.low is None or its.high is None:
        yield (
            f"With one seed, there is no interval for the difference between {row.title} and {floor.title}: "
            "another seed may give a different result."
        )
    elif ours.low <= its.high and its.low <= ours.high:
        yield (
            f"The {_SURE} intervals of {row.title} and {floor.title} overlap: these seeds do not show "
            "that they differ."
        )
    elif (seeds := min(len(row.seeds), len(floor.seeds))) < _ENOUGH_SEEDS:
        yield (
            f"{row.title} and {floor.title} are compared over only {seeds} seeds: equal rows may differ as "
            "much by chance."
        )


def _floors(results: Results) -> list[tuple[str, MethodResults]]:
    return [(name, row) for name, row in results.methods.items() if row.role == "floor"]


def _is_predicted(results: Results) -> bool:
    """Whether rows are compared by what judges predict: the target told nothing, and a policy was chosen."""
    return results.tested_in != "target" and chosen_of(results) is not None


def _worth(results: Results) -> dict[str, float]:
    """Return by what rows are compared: the mean of the score, or of the predicted success where that is."""
    if not _is_predicted(results) or results.choice is None:
        return {name: _mean(results, row) for name, row in results.methods.items()}
    predicted: dict[str, list[float]] = {}
    for one in results.choice.candidates:
        if one.row in results.methods:
            predicted.setdefault(one.row, []).append(one.predicted)
    return {name: fmean(values) for name, values in predicted.items()}


def _mean(results: Results, row: MethodResults) -> float:
    return row.summary[results.headline.measure].mean


def _why_chosen(results: Results, chosen: Ranked, percent: int | None) -> str:
    predicted = _with_interval(chosen.predicted, chosen.low, chosen.high)
    text = f". Its success, predicted without the target, is {predicted}"
    if chosen.target is None:
        text += "; it was not measured in the target"
    else:
        measured = _with_interval(chosen.target, *_ends(results, chosen.target))
        text += f"; measured in the target, it is {measured} over {results.episodes} episodes"
    count = len(results.choice.candidates) if results.choice else 0
    return f"{text}. The select stage chose it from {count} policies{_trained(results, percent)}."


def _why_best(results: Results, row: MethodResults, percent: int | None) -> str:
    seeds = "best mean over seeds" if len(results.seeds) > 1 else "best result"
    return (
        f": {_score(results, row)}. This row has the {seeds}{_trained(results, percent)}; "
        "the select stage chose no policy."
    )


def _trained(results: Results, percent: int | None) -> str:
    """Return on how much data the policies were trained; empty if the results do not tell."""
    share = "" if percent is None else f"{percent}{_PERCENT} of "
    if source := results.settings.get("data"):
        return f", trained on {share}the episodes of {source}"
    collect = results.settings.get("collect")
    if not isinstance(collect, dict) or not collect.get("episodes"):
        return ""
    steps, seeds = collect.get("least_steps"), len(results.seeds)
    amount = f"{steps:,} steps" if isinstance(steps, int) else f"{collect['episodes']} episodes"
    return f", trained on {share}{amount} of data{f' for each of {seeds} seeds' if seeds > 1 else ''}"


def _with_interval(share: float, low: float | None, high: float | None) -> str:
    ends = "interval withheld" if low is None else f"{_SURE} interval {low:.2f} to {high:.2f}"
    return f"{share:.2f} ({ends})"


def _seeds(row: MethodResults) -> str:
    return "one seed" if len(row.seeds) == 1 else f"{len(row.seeds)} seeds"


def _score(results: Results, row: MethodResults) -> str:
    score = results.headline
    summary = row.summary[score.measure]
    middle = ""
    if summary.low is not None and summary.high is not None:
        ends = f"{_SURE} interval {score.text(summary.low)} to {score.text(summary.high)}"
        middle = f"; interquartile mean {score.text(summary.iqm)}, {ends}"
    tested = f"{_seeds(row)} with {results.episodes} episodes{' each' if len(row.seeds) > 1 else ''}"
    return f"{score.title} {spread(summary, score.digits)} {where(results)} ({tested}{middle})"


def _ends(results: Results, share: float) -> tuple[float, float]:
    """Return the 95 % interval of a policy's success over its episodes."""
    return share_interval(round(share * results.episodes), results.episodes)


def _of_choice(results: Results, chosen: Ranked) -> Iterator[Fact]:
    ends = "interval withheld" if chosen.low is None else f"{_SURE} [{chosen.low:.2f}, {chosen.high:.2f}]"
    judges = f"{chosen.judges} judge{'s' if chosen.judges > 1 else ''}"
    yield Fact("Predicted success", f"{chosen.predicted:.2f}", f"{ends}, by {judges}")
    if chosen.target is None:
        yield Fact("Measured success", "-", "not tested in the target")
    else:
        low, high = _ends(results, chosen.target)
        note = f"{_SURE} [{low:.2f}, {high:.2f}], {results.episodes} episodes of this policy"
        yield Fact("Measured success", f"{chosen.target:.2f}", note)


def _of_row(results: Results, row: MethodResults) -> Fact:
    score = results.headline
    summary = row.summary[score.measure]
    place = "" if results.tested_in == "target" else f" {where(results)}"
    if summary.low is None or summary.high is None:
        note = f"{score.title}{place}, {_seeds(row)}: no interval"
    else:
        ends = interval(summary.iqm, summary.low, summary.high, score.digits)
        note = f"{score.title}{place}, {_seeds(row)}; IQM {ends}"
    label = f"{row.title} ({row.role})" if row.role else row.title
    return Fact(label, spread(summary, score.digits), note)
