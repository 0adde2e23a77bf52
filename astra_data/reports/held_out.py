"""How good corrections are, and how much data is enough: errors on held-out episodes, without a target."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from astra_data.core.durable import write_file
from astra_data.methods import method_title
from astra_data.reports.blocks import Block, Section, TableBlock, Text, markdown, measured
from astra_data.reports.predicted_failures import all_bins, failure_rates, predicted_failures
from astra_data.reports.results import Results, judged_horizon
from astra_data.reports.runs import read_errors, read_grounding

if TYPE_CHECKING:
    import pandas as pd

PAGE = "gap.md"
RELIABILITY = "gap_reliability.png"
_SURE = 0.1
"""Probability of a failure soon above which predictions are compared with what happened."""
_EXACT = 1e-3
"""Share of the persistence baseline's error below which a prediction is exact."""
_FITS = {
    "r2_state": "state",
    "r2_reward": "reward of steps that go on",
    "r2_latent": "latent",
}
"""R² of a grounding's heads, and their titles."""


def write_held_out(
    recipe: str,
    root: Path,
    groundings: Sequence[str],
    seeds: Sequence[int],
    percents: Sequence[int],
    *,
    timestep_s: float,
) -> Path | None:
    """Write the page of all finished groundings to `root`; return it, None where there is no grounding.

    Beside it is a figure where groundings predict failures.

    Args:
        recipe: its name.
        root: its folder of runs.
        groundings: the methods that ground.
        seeds: of the recipe.
        percents: sizes of the dataset; empty for the whole alone.
        timestep_s: of the task.

    Raises:
        BadInputError: a file of errors is malformed.
    """
    places = [
        (root, row, seed, percent)
        for row in groundings
        for percent in sorted(percents) or (None,)
        for seed in sorted(seeds)
    ]
    results = Results(
        recipe=recipe,
        task="",
        command="",
        rows=tuple(groundings),
        episodes=0,
        timestep_s=timestep_s,
        lines=[line for place in places for line in read_grounding(*place)],
        errors=[error for place in places for error in read_errors(*place)],
    )
    if not results.errors:
        return None
    seeds_text = ", ".join(map(str, sorted({one.seed for one in results.errors})))
    blocks: list[Block] = [
        Text(
            "Errors of the simulators on episodes that no grounding was fitted to. Each simulator starts in "
            "a state of the robot and receives its recorded actions. Mean [95 % interval over episodes], "
            f"averaged over seeds {seeds_text}."
        ),
        *gap_blocks(results),
    ]
    figures = {}
    if rates := failure_rates(results):
        from astra_data.reports.figures.catalog import pictures
        from astra_data.reports.figures.errors import reliability
        from astra_data.reports.figures.style import png

        write_file(root / RELIABILITY, png(reliability(rates)))
        blocks += pictures(results, "failures")
        figures["reliability"] = RELIABILITY
    write_file(root / PAGE, markdown(f"{recipe}: held-out errors", [Section("", blocks)], figures))
    return root / PAGE


def gap_blocks(results: Results) -> Iterator[Block]:
    """Yield errors by horizon, what they mean, and how well rewards and failures are predicted."""
    if not results.errors:
        return
    sizes = results.percents
    means = {percent: results.mean_errors(percent) for percent in sizes}
    horizons = sorted(set.intersection(*(set(of.index.get_level_values("horizon")) for of in means.values())))
    quantities = list(dict.fromkeys(error.quantity for error in results.errors))
    swept = len(sizes) > 1
    step_s = results.timestep_s
    titles = [
        f"{steps} step{'s' if steps > 1 else ''}{f' ({steps * step_s:.3g} s)' if step_s else ''}"
        for steps in horizons
    ]
    for quantity in quantities:
        lines = [
            [*([f"{percent} %"] if swept else []), *line]
            for percent in sizes
            for line in _error_lines(results, means[percent], quantity, horizons)
        ]
        head = [*(["size"] if swept else []), "simulator", *titles]
        yield TableBlock(f"Error of `{quantity}`", head, lines, words=len(head) - len(horizons))
    last = means[sizes[-1]]
    if still := no_better_than_still(last):
        names = ", ".join(f"`{name}`" for name in still)
        yield Text(
            f"**In {names}, the simulator without grounding is no better than predicting that the state "
            "does not change.** If it should be better, check the units and the order of states and "
            "commands, the rate, and the abstraction φ (phi), which maps the robot's states to the "
            "simulator's.",
            warns=True,
        )
    if worse := [*_regressions(results, last)]:
        yield Text(
            "**Here the correction makes the simulator worse.** More data, or other settings of `[ground]`, "
            "may help; policies that are trained in it learn its errors.",
            worse,
            warns=True,
        )
    if swept:
        yield Text("How much data is enough:", [*_sufficient_sizes(results, means, quantities, horizons)])
        yield Text(
            "Each size holds out a share of its own episodes, so smaller sizes are measured on fewer of "
            "them: compare with the line without grounding of the same size."
        )
    yield from _fit_blocks(results)
    yield from _failure_blocks(results)


def _error_lines(
    results: Results, means: "pd.DataFrame", quantity: str, horizons: Sequence[int]
) -> Iterator[list[str]]:
    """Yield a line for each simulator at a size; what all groundings share, once."""
    groundings = [row for row in results.groundings() if (row, "grounded") in means.index]

    def cells(row: str, simulator: str) -> list[str]:
        at = [means.loc[(row, simulator, quantity, horizon)] for horizon in horizons]
        return [measured(one["mean"], one["low"], one["high"]) for one in at]

    if (groundings[0], "still") in means.index:
        yield ["No motion (persistence baseline)", *cells(groundings[0], "still")]
    raw = {row: cells(row, "raw") for row in groundings}
    shared = len(set(map(tuple, raw.values()))) == 1
    if shared:
        yield ["No grounding", *raw[groundings[0]]]
    for row in groundings:
        if not shared:
            yield [f"{method_title(row)}, no grounding", *raw[row]]
        yield [f"{method_title(row)}, grounded", *cells(row, "grounded")]


def no_better_than_still(means: "pd.DataFrame") -> list[str]:
    """Return the quantities in which the raw simulator is no better than the persistence baseline.

    Not after the first step: a robot that lags behind its commands hardly leaves its state in one.
    """
    found = means["mean"].groupby(["simulator", "quantity", "horizon"], sort=False).first()
    if "still" not in found.index:
        return []
    horizon = judged_horizon(found.index.get_level_values("horizon"))
    raw, still = (found[simulator].xs(horizon, level="horizon") for simulator in ("raw", "still"))
    return [quantity for quantity in still.index if raw[quantity] >= still[quantity]]


def _regressions(results: Results, means: "pd.DataFrame") -> Iterator[str]:
    """Yield where a grounding, fitted to the most data, has larger errors than the simulator without one."""
    for row in results.groundings():
        if row not in means.index:
            continue
        of = means.loc[row, "mean"].unstack("simulator")
        # What both predict to a thousandth of the baseline, they compute exactly but for rounding.
        least = _EXACT * of.get("still", 0.0)
        worse = of[(of["grounded"] > of["raw"]) & (of["grounded"] > least)]
        for quantity, lines in worse.groupby(level="quantity", sort=False):
            found = [
                f"{steps} step{'s' if steps > 1 else ''} ahead ({line['grounded']:.3g}, without "
                f"{line['raw']:.3g})"
                for (_, steps), line in lines.iterrows()
            ]
            yield f"`{quantity}`, {method_title(row)}: {', '.join(found)}"


def _sufficient_sizes(
    results: Results, means: "dict[int, pd.DataFrame]", quantities: Sequence[str], horizons: Sequence[int]
) -> Iterator[str]:
    """Yield from which size on more data makes no difference that the intervals show.

    That is the smallest one whose error, and those of all larger ones, are at most the upper end of the
    interval of the largest.
    """
    horizon = judged_horizon(horizons)
    for row in results.groundings():
        of = {percent: found.loc[row] for percent, found in means.items() if row in found.index}
        *smaller, largest = sorted(of)
        for quantity in quantities if smaller else ():
            at = {percent: found.loc[("grounded", quantity, horizon)] for percent, found in of.items()}
            limit, least = at[largest]["high"], largest
            where = f"{method_title(row)}, `{quantity}`, {horizon} steps ahead: "
            if np.isnan(limit):
                yield f"{where}unknown: at {largest} %, a seed has only one held-out episode of that length."
                continue
            for percent in reversed(smaller):
                if at[percent]["mean"] > limit:
                    break
                least = percent
            if least == largest:
                yield f"{where}the error still decreases up to {largest} %: more data may help."
            else:
                yield f"{where}from {least} % on, the error is within the interval of {largest} %."


def _fit_blocks(results: Results) -> Iterator[Block]:
    """Yield the R² of the heads of each grounding on held-out episodes."""
    rows = results.groundings()
    found = {row: {name: results.summary(row, name, "ground") for name in _FITS} for row in rows}
    shown = [name for name in _FITS if any(of[name] for of in found.values())]
    lines = [
        [method_title(row), *("-" if (one := of[name]) is None else f"{one.mean:.2f}" for name in shown)]
        for row, of in found.items()
    ]
    if shown:
        yield TableBlock(
            "R² of what groundings predict on held-out episodes (1: perfect; 0 or less: no better than the "
            "mean)",
            ["grounding", *(_FITS[name] for name in shown)],
            lines,
        )


def _failure_blocks(results: Results) -> Iterator[Block]:
    lines, swept = [], len(results.percents) > 1
    for (percent, row, part), of in predicted_failures(results).items():
        means = of.mean(axis=1)
        known = (means.get(f"auc.{ahead}") for ahead in ("1-20", "11-30", "21-40"))
        aucs = ["-" if value is None else f"{value:.2f}" for value in known]
        skill = f"{means['brier_skill']:.2f}" if "brier_skill" in means else "-"
        bins = all_bins(of)
        sure = bins[bins[:, 0] > _SURE]
        happens = "-"
        if len(sure):
            predicted, observed = np.average(sure[:, :2], axis=0, weights=sure[:, 2])
            happens = f"{observed:.2f} of {predicted:.2f}"
        title = f"{method_title(row)}: {part.replace('_', ' ')}"
        size = [f"{percent} %"] if swept else []
        lines.append([*size, title, f"{of.loc['failures'].sum():.0f}", *aucs, skill, happens])
    if not lines:
        return
    windows = ("AUC 1\N{EN DASH}20 steps", "11\N{EN DASH}30", "21\N{EN DASH}40")
    head = [*(["size"] if swept else []), "predicted by", "failures", *windows, "Brier skill"]
    head = [*head, "observed of predicted"]
    yield TableBlock(
        "Failures, predicted on held-out episodes; means over seeds", head, lines, words=1 + swept
    )
    yield Text(
        "AUC: the probability that a step this many steps before a failure ranks above a step with no "
        "failure in the next 40. Brier skill: the share of squared error removed, compared with always "
        "predicting the mean rate. Observed of predicted: over the steps with a predicted probability above "
        "0.1, the share before a failure, and the mean predicted probability. With few failures, these "
        "numbers mean little."
    )
