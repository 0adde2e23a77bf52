"""How good corrections are, and how much data is enough: errors on held-out episodes, without a target."""

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from astra_data.core.durable import write_file
from astra_data.methods import method_title
from astra_data.reports.blocks import Block, Section, TableBlock, Text, markdown
from astra_data.reports.results import Results, all_bins, judged_horizon
from astra_data.reports.runs import Owner, RunReader, Selection

if TYPE_CHECKING:
    import pandas as pd

PAGE = "gap.md"
RELIABILITY = "gap_reliability.png"
_SURE = 0.1  # probability of a failure soon above which predictions are compared with what happened
_EXACT = 1e-3  # share of the persistence baseline's error below which a prediction is exact
_FITS = {"r2_state": "state", "r2_reward": "reward of steps that go on", "r2_latent": "latent"}
"""R² of a grounding's heads, and their titles."""


def write_held_out(recipe: str, root: Path, of: Selection, *, timestep_s: float) -> Path | None:
    """Write the page of the finished groundings of a selection, and a figure if they predict failures; None of none."""
    run = RunReader(root)
    for row, percent, seed in product(of.methods, sorted(of.percents) or (None,), sorted(of.seeds)):
        run.grounding(Owner(row, seed, percent))
    if not run.errors:
        return None
    parts: dict[str, Any] = {"timestep_s": timestep_s, "lines": run.lines, "errors": run.errors}
    results = Results(recipe=recipe, task="", command="", rows=of.methods, episodes=0, **parts)
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
    if rates := results.failure_rates():
        from astra_data.reports.figures.catalog import pictures
        from astra_data.reports.figures.charts import reliability
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
    means = {size: of for size in results.percents if not (of := results.mean_errors(size)).empty}
    horizons = sorted(set.intersection(*(set(of.index.get_level_values("horizon")) for of in means.values())))
    quantities = list(dict.fromkeys(error.quantity for error in results.errors))
    step_s = results.timestep_s
    titles = [f"{n} step{'s' if n > 1 else ''}{f' ({n * step_s:.3g} s)' if step_s else ''}" for n in horizons]
    head = [*_size(results), "simulator", *titles]
    for quantity in quantities:
        lines = [
            [*_size(results, percent), *line]
            for percent, of in means.items()
            for line in _error_lines(results, of, quantity, horizons)
        ]
        yield TableBlock(f"Error of `{quantity}`", head, lines, words=len(head) - len(horizons))
    last = means[max(means)]
    if still := _no_better_than_still(last):
        names = ", ".join(f"`{name}`" for name in still)
        yield Text(
            f"**In {names}, the simulator without grounding is no better than predicting that the state does not "
            "change.** If it should be better, check the units and the order of states and commands, the rate, and the "
            "abstraction φ (phi), which maps the robot's states to the simulator's.",
            warns=True,
        )
    if worse := [*_regressions(results, last)]:
        yield Text(
            "**Here the correction makes the simulator worse.** More data, or other settings of `[ground]`, "
            "may help; policies that are trained in it learn its errors.",
            worse,
            warns=True,
        )
    if results.is_swept:
        yield Text("How much data is enough:", [*_sufficient_sizes(results, means, quantities, horizons)])
        yield Text(
            "Unless the dataset marks episodes as held out, each size holds out a share of its own, so smaller sizes "
            "are measured on fewer of them: compare with the line without grounding of the same size."
        )
    rows = results.groundings()
    found = {title: [results.summary(row, name, "ground") for row in rows] for name, title in _FITS.items()}
    if shown := {title: of for title, of in found.items() if any(of)}:
        cells = [[f"{one.value:z.2f}" if one else "-" for one in of] for of in shown.values()]
        title = "R² of what groundings predict on held-out episodes (1: perfect; 0 or less: no better than the mean)"
        yield TableBlock(title, ["grounding", *shown], [*zip(map(method_title, rows), *cells, strict=True)])
    yield from _failure_blocks(results)


def _size(results: Results, percent: int | None = None) -> list[str]:
    """Return the cell of a size, or the head of these, where there are several."""
    return ([f"{percent} %"] if percent else ["size"]) if results.is_swept else []


def _error_lines(results: Results, means: "pd.DataFrame", quantity: str, horizons: list[int]) -> Iterator[list[str]]:
    """Yield a line for each simulator at a size; what all groundings share, once."""
    groundings = [row for row in results.groundings() if (row, "grounded") in means.index]

    def cells(row: str, simulator: str) -> list[str]:
        at = [means.loc[(row, simulator, quantity, horizon)].to_numpy() for horizon in horizons]
        ends = ["" if np.isnan(one[1:]).any() else f" [{one[1]:.3g}, {one[2]:.3g}]" for one in at]
        return [f"{one[0]:.3g}{end}" for one, end in zip(at, ends, strict=True)]

    if (groundings[0], "still") in means.index:
        yield ["No motion (persistence baseline)", *cells(groundings[0], "still")]
    raw = {row: cells(row, "raw") for row in groundings}
    is_shared = len(set(map(tuple, raw.values()))) == 1
    if is_shared:
        yield ["No grounding", *raw[groundings[0]]]
    for row in groundings:
        if not is_shared:
            yield [f"{method_title(row)}, no grounding", *raw[row]]
        yield [f"{method_title(row)}, grounded", *cells(row, "grounded")]


def _no_better_than_still(means: "pd.DataFrame") -> list[str]:
    """Return the quantities in which the raw simulator is no better than persistence at the judged horizon."""
    of = means["mean"].groupby(["simulator", "quantity", "horizon"], sort=False).first()
    if "still" not in of.index:
        return []
    horizon = judged_horizon(of.index.get_level_values("horizon"))
    raw, still = (of[simulator].xs(horizon, level="horizon") for simulator in ("raw", "still"))
    return [quantity for quantity in still.index if raw[quantity] >= still[quantity]]


def _regressions(results: Results, means: "pd.DataFrame") -> Iterator[str]:
    """Yield where a grounding has larger errors than the simulator without one, beyond the intervals over episodes."""
    for row in (row for row in results.groundings() if row in means.index):
        of = means.loc[row, "mean"].unstack("simulator")
        low, high = (means.loc[row, end].unstack("simulator") for end in ("low", "high"))
        apart = ~(low["grounded"] <= high["raw"])  # without an interval as well
        # What both predict to a thousandth of the baseline, they compute exactly but for rounding.
        worse = of[(of["grounded"] > of["raw"]) & apart & (of["grounded"] > _EXACT * of.get("still", 0.0))]
        for quantity, lines in worse.groupby(level="quantity", sort=False):
            found = [
                f"{steps} step{'s' if steps > 1 else ''} ahead ({line['grounded']:.3g}, without {line['raw']:.3g})"
                for (_, steps), line in lines.iterrows()
            ]
            yield f"`{quantity}`, {method_title(row)}: {', '.join(found)}"


def _sufficient_sizes(
    results: Results, means: "dict[int, pd.DataFrame]", quantities: Sequence[str], horizons: Sequence[int]
) -> Iterator[str]:
    """Yield from which size on all errors are at most the upper end of the interval of the largest."""
    horizon = judged_horizon(horizons)
    for row in results.groundings():
        of = {percent: found.loc[row] for percent, found in means.items() if row in found.index}
        *smaller, largest = sorted(of)
        for quantity in quantities if smaller else ():
            at = {percent: found.loc[("grounded", quantity, horizon)] for percent, found in of.items()}
            limit = at[largest]["high"]
            above = [percent for percent in smaller if not at[percent]["mean"] <= limit]
            least = min(percent for percent in of if percent > max(above, default=0))
            found = f"from {least} % on, the error is within the interval of {largest} %."
            if np.isnan(limit):
                found = f"unknown: at {largest} %, a seed has only one held-out episode of that length."
            elif least == largest:
                found = f"the error still decreases up to {largest} %: more data may help."
            yield f"{method_title(row)}, `{quantity}`, {horizon} steps ahead: {found}"


def _failure_blocks(results: Results) -> Iterator[Block]:
    lines = []
    for (percent, row, part), of in results.predicted_failures().items():
        means = of.mean(axis=1)
        names = (*(f"auc.{ahead}" for ahead in ("1-20", "11-30", "21-40")), "brier_skill")
        known = [f"{means[name]:z.2f}" if name in means else "-" for name in names]
        bins, happens = all_bins(of), "-"
        if len(sure := bins[bins[:, 0] > _SURE]):
            predicted, observed = np.average(sure[:, :2], axis=0, weights=sure[:, 2])
            happens = f"{observed:.2f} of {predicted:.2f}"
        title = f"{method_title(row)}: {part.replace('_', ' ')}"
        lines.append([*_size(results, percent), title, f"{of.loc['failures'].sum():.0f}", *known, happens])
    if not lines:
        return
    windows = ("AUC 1\N{EN DASH}20 steps", "11\N{EN DASH}30", "21\N{EN DASH}40")
    head = [*_size(results), "predicted by", "failures", *windows, "Brier skill", "observed of predicted"]
    title = "Failures, predicted on held-out episodes: AUC and skill are means over the seeds, the rest is of all"
    yield TableBlock(title, head, lines, words=1 + results.is_swept)
    yield Text(
        "AUC: the probability that a step this many steps before a failure ranks above a step with no failure in the "
        "next 40. Brier skill: the share of squared error removed, compared with always predicting the mean rate. "
        "Observed of predicted: over the steps with a predicted probability above 0.1, the share before a failure, and "
        "the mean predicted probability. With few failures, these numbers mean little."
    )
