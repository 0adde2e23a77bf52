"""How good corrections are, and how much data is enough: errors on held-out episodes, without a target."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.durable import write_file
from astra_data.core.naming import artifact_key
from astra_data.grounding.failures import BINS
from astra_data.methods import method_title
from astra_data.reports.artifacts import GAP, METRICS, Foresight, Gap, Metrics, read_json
from astra_data.reports.assembly import mean_gap
from astra_data.reports.formatting import fill, measured
from astra_data.reports.schema import GapMeans, judged_horizon, shared_horizons

Measured = Mapping[int | None, Mapping[str, Mapping[str, Sequence[Foresight]]]]
"""How failures are foreseen on each seed, by size (the largest last), grounding, and part of it."""

PAGE = "gap.md"
RELIABILITY = "gap_reliability.png"
_SURE = 0.1
"""Probability of a failure soon above which predictions are compared with what happened."""


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

    Beside it is a figure where groundings have failure models.

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
    found: dict[str, dict[int | None, GapMeans]] = {}
    for method in groundings:
        for percent in sorted(percents) or (None,):
            files = {
                seed: root / artifact_key("ground", method, seed, percent) / GAP for seed in sorted(seeds)
            }
            gaps = {seed: read_json(Gap, file) for seed, file in files.items() if file.is_file()}
            if gaps:
                found.setdefault(method, {})[percent] = mean_gap(gaps)
    if not found:
        return None
    every = [gap for sizes in found.values() for gap in sizes.values()]
    horizons = shared_horizons([gap.horizons for gap in every])
    by_size = {percent or 0: gap for sizes in found.values() for percent, gap in sizes.items()}
    foreseen = measured_foresight(root, groundings, seeds, percents)
    rates = failure_rates(foreseen)
    if rates:
        from astra_data.reports.figures import png, reliability

        write_file(root / RELIABILITY, png(reliability(rates)))
    page = fill(
        "held_out.md.jinja",
        recipe=recipe,
        seeds=sorted({seed for gap in every for seed in gap.seeds}),
        head=[*(["size"] if percents else []), "simulator"],
        horizons=[f"{h} step{'s' if h > 1 else ''} ({h * timestep_s:g} s)" for h in horizons],
        tables={name: _lines(found, name, horizons, has_sizes=bool(percents)) for name in every[0].raw},
        astray=astray(by_size[max(by_size)]),
        worse=[line for method, sizes in found.items() for line in worse(method_title(method), sizes)],
        foresight=foresight_lines(foreseen),
        reliability=RELIABILITY if rates else None,
        enough=[
            enough(method_title(method), name, sizes, horizons)
            for method, sizes in found.items()
            for name in every[0].raw
            if len(sizes) > 1
        ],
    )
    write_file(root / PAGE, page)
    return root / PAGE


def astray(gap: GapMeans) -> list[str]:
    """Return the quantities in which the raw simulator is no better than who expects the robot to stay.

    Not after the first step: a robot that lags behind its commands hardly leaves its state in one.
    """
    horizon = judged_horizon(gap.horizons)
    return [
        name
        for name, band in (gap.still or {}).items()
        if gap.at(gap.raw[name], horizon)[0] >= gap.at(band, horizon)[0]
    ]


def worse(title: str, sizes: Mapping[int | None, GapMeans]) -> list[str]:
    """Say where a grounding, fitted to the most data, has larger errors than the simulator without one."""
    gap = sizes[max(sizes, key=lambda percent: percent or 0)]
    lines = []
    for name, band in gap.grounded.items():
        found = [
            f"{horizon} step{'s' if horizon > 1 else ''} ahead ({ours:.3g}, without {its:.3g})"
            for horizon in gap.horizons
            if (ours := gap.at(band, horizon)[0]) > (its := gap.at(gap.raw[name], horizon)[0])
        ]
        if found:
            lines.append(f"`{name}`, {title}: {', '.join(found)}")
    return lines


def measured_foresight(
    root: Path, groundings: Sequence[str], seeds: Sequence[int], percents: Sequence[int]
) -> Measured:
    """Read how well groundings foresee failures, on the seeds where some were held out.

    Raises:
        BadInputError: a file of figures is malformed.
    """
    return {
        percent: {method: _measured(root, method, seeds, percent) for method in groundings}
        for percent in sorted(percents) or (None,)
    }


def foresight_lines(measured: Measured) -> list[list[str]]:
    """Return a line for each size, grounding and part of it that foresees failures, with means over seeds."""
    lines = []
    for percent, of_methods in measured.items():
        for method, parts in of_methods.items():
            for part, found in parts.items():
                title = f"{method_title(method)}: {part.replace('_', ' ')}"
                size = [] if percent is None else [f"{percent} %"]
                lines.append([*size, title, *_foresight_cells(found)])
    return lines


def _measured(
    root: Path, method: str, seeds: Sequence[int], percent: int | None
) -> dict[str, list[Foresight]]:
    measured: dict[str, list[Foresight]] = {}
    for seed in seeds:
        file = root / artifact_key("ground", method, seed, percent) / METRICS
        for part, one in read_json(Metrics, file).failures.items() if file.is_file() else ():
            if one.auc:
                measured.setdefault(part, []).append(one)
    return measured


def failure_rates(measured: Measured) -> dict[str, dict[str, Floats]]:
    """Return rates by part that foresees failures and grounding, as a figure takes them.

    They are over all seeds, at the largest size.
    """
    parts: dict[str, dict[str, Floats]] = {}
    largest = [*measured.values()][-1]
    for method, of_parts in largest.items():
        for part, found in of_parts.items():
            rows = np.array([row for one in found for row in one.reliability or ()])
            parts.setdefault(part.replace("_", " "), {})[method] = _pooled(rows.reshape(-1, 3))
    return parts


def _pooled(rows: Floats) -> Floats:
    """Pool rows (N, 3) of predicted and observed rates and numbers of steps by bin: (3, bins)."""
    bins = np.digitize(rows[:, 0], BINS[1:-1])
    steps = np.array([rows[bins == one, 2].sum() for one in np.unique(bins)])
    rates = [rows[bins == one, :2].T @ rows[bins == one, 2] for one in np.unique(bins)]
    return np.vstack([np.reshape(rates, (-1, 2)).T / steps, steps])


def _foresight_cells(found: Sequence[Foresight]) -> list[str]:
    known = [
        [value for one in found if one.auc and (value := one.auc[window]) is not None]
        for window in found[0].auc or ()
    ]
    aucs = [f"{fmean(values):.2f}" if values else "-" for values in known]
    skills = [one.brier_skill for one in found if one.brier_skill is not None]
    skill = f"{fmean(skills):.2f}" if skills else "-"
    sure = [row for one in found for row in one.reliability or () if row[0] > _SURE]
    steps = sum(count for *_, count in sure)
    means = [sum(row[index] * row[2] for row in sure) / steps for index in (0, 1)] if steps else []
    happens = f"{means[1]:.2f} of {means[0]:.2f}" if means else "-"
    return [f"{sum(one.failures for one in found)}", *aucs, skill, happens]


def enough(title: str, quantity: str, sizes: Mapping[int | None, GapMeans], horizons: Sequence[int]) -> str:
    """Say from which size on more data makes no difference that the intervals show.

    That is the smallest one whose error, and those of all larger ones, are at most the upper end of the
    interval of the largest.
    """
    horizon = judged_horizon(horizons)
    errors = {size: gap.at(gap.grounded[quantity], horizon) for size, gap in sizes.items()}
    *smaller, largest = errors
    limit, least = errors[largest][2], largest
    where = f"{title}, `{quantity}`, {horizon} steps ahead: "
    if limit is None:
        return f"{where}withheld: at {largest} %, a seed has only one held-out episode of that length."
    for size in reversed(smaller):
        if errors[size][0] > limit:
            break
        least = size
    if least == largest:
        return f"{where}the error still decreases up to {largest} %: more data may help."
    return f"{where}from {least} % on, the error is within the interval of {largest} %."


def _lines(
    found: Mapping[str, Mapping[int | None, GapMeans]],
    quantity: str,
    horizons: Sequence[int],
    *,
    has_sizes: bool,
) -> list[list[str]]:
    lines = []
    for size in sorted({size for sizes in found.values() for size in sizes}, key=lambda size: size or 0):
        sized = {method_title(method): sizes[size] for method, sizes in found.items() if size in sizes}
        first = next(iter(sized.values()))
        bands = {"Standing still": (first.still[quantity], first)} if first.still else {}
        bands |= {"No grounding": (first.raw[quantity], first)}
        bands |= {title: (gap.grounded[quantity], gap) for title, gap in sized.items()}
        for title, (band, gap) in bands.items():
            cells = [measured(*gap.at(band, horizon)) for horizon in horizons]
            lines.append([*([f"{size} %"] if has_sizes else []), title, *cells])
    return lines
