"""Where each row loses: from its own simulator to the target, and by failing or running out of time there."""

from dataclasses import dataclass

import numpy as np

from astra_data.reports.formatting import interval, mean_std, spread
from astra_data.reports.schema import MethodResults, Results, judged_horizon
from astra_data.reports.tested import where
from astra_data.worlds.score import SUCCESS


@dataclass(frozen=True)
class Loss:
    """A row's line.

    Attributes:
        name: of the row.
        title: of the row.
        role: what it is to the others, if something.
        cells: the other columns, as in `loss_head`.
        outcomes: kind of outcome → mean share of the episodes; they add up to 1.
        simulated: success in the simulator that it was trained in; None if that is unknown or no share.
    """

    name: str
    title: str
    role: str | None
    cells: list[str]
    outcomes: dict[str, float]
    simulated: float | None


def loss_head(results: Results) -> list[str]:
    """Return the titles of the columns behind the row's title and its outcomes."""
    scores = [
        title
        for score in results.scores
        for title in (f"{score.title} {where(results)}", "IQM [95\N{NO-BREAK SPACE}%]")
    ]
    return [f"{results.headline.title} in its simulator", *scores, "lost", "failed", _last(results), "seeds"]


def _last(results: Results) -> str:
    """Return how episodes end that neither fail nor reach a goal before their horizon."""
    return "out of time" if results.headline == SUCCESS else "lasted"


def losses(results: Results) -> list[Loss]:
    """Return a line for each row, in the order of the results."""
    return [_loss(results, name, row) for name, row in results.methods.items()]


def _loss(results: Results, name: str, row: MethodResults) -> Loss:
    headline, last = results.headline, _last(results)
    simulated = row.summary.get(f"simulated_{headline.measure}")
    reached, failed = np.array(row.success), np.array(row.failed)
    if headline == SUCCESS:
        late = np.clip(1.0 - reached - failed, 0.0, 1.0)
        outcomes = {"success": reached, "failed": failed, last: late}
    else:
        outcomes = {last: 1.0 - failed, "failed": failed}
    cells = [spread(simulated, headline.digits) if simulated else "-"]
    for score in results.scores:
        summary = row.summary[score.measure]
        cells.append(spread(summary, score.digits))
        cells.append(
            "one seed"
            if summary.low is None
            else interval(summary.iqm, summary.low, summary.high, score.digits)
        )
    lost = simulated.mean - row.summary[headline.measure].mean if simulated else None
    # A minus sign of a rounded zero says nothing.
    cells.append("-" if lost is None else f"{round(lost, headline.digits) + 0.0:.{headline.digits}f}")
    cells += [mean_std(list(outcomes[kind]), 2) for kind in ("failed", last)]
    cells.append(f"{len(row.seeds)}")
    return Loss(
        name=name,
        title=row.title,
        role=row.role,
        cells=cells,
        outcomes={kind: float(shares.mean()) for kind, shares in outcomes.items()},
        simulated=simulated.mean if simulated and headline == SUCCESS else None,
    )


def seed_lines(results: Results) -> tuple[list[str], list[list[str]]]:
    """Return head and lines of every measure of every row and seed, without those that no row has."""
    rows = results.methods.values()
    measures = [name for name in next(iter(rows)).measures() if any(name in row.summary for row in rows)]
    lines = []
    for row in rows:
        found = row.measures()
        for number, seed in enumerate(row.seeds):
            values = [of[number] if (of := found[name]) else None for name in measures]
            cells = ["-" if value is None or np.isnan(value) else f"{value:.4g}" for value in values]
            lines.append([row.title, f"{seed}", *cells])
    return ["row", "seed", *(name.replace("_", " ") for name in measures)], lines


def remaining_errors(results: Results) -> tuple[int, list[str], list[list[str]]]:
    """Return how much of each open-loop error is left where it is corrected, of `results` with a gap.

    Returns:
        The horizon; the names of the groundings; and a line for each quantity.
    """
    gaps = results.gaps()
    first = next(iter(gaps.values()))
    horizon = judged_horizon(first.horizons)
    lines = []
    for quantity in first.raw:
        cells = []
        for gap in gaps.values():
            if horizon not in gap.horizons or quantity not in gap.raw:
                cells.append("-")
                continue
            raw, left = (gap.at(of[quantity], horizon)[0] for of in (gap.raw, gap.grounded))
            share = f" ({100 * left / raw:.0f} %)" if raw > 0 else ""
            cells.append(f"{left:.3g} of {raw:.3g}{share}")
        lines.append([quantity, *cells])
    return horizon, list(gaps), lines
