"""Results → Markdown; the text is in `templates/recipe.md.jinja`."""

from collections.abc import Callable, Mapping

from astra_data.core.naming import is_plus, reference_of
from astra_data.methods import method_title
from astra_data.reports.choice_page import choice_values
from astra_data.reports.cost_and_origin import (
    COSTED,
    dataset_lines,
    machines,
    provenance,
    row_costs,
    stage_costs,
)
from astra_data.reports.formatting import fill, interval, mean_std, measured, spread
from astra_data.reports.schema import BandMeans, GapMeans, MethodResults, Results, shared_horizons
from astra_data.reports.statistics import Correlation
from astra_data.reports.tested import warning, where
from astra_data.worlds.score import SUCCESS

BESIDE = {
    "success": (
        *("failed", "wall_contact", "steps", "distance", "return"),
        *("simulated_success", "tries", "beyond_recorded"),
    ),
    "steps": ("failed", "simulated_steps", "tries", "beyond_recorded"),
}
"""Headline → the other measures in the table of scores; beside another one, those of success."""
OF_PLANES = {"wall_contact", "distance"}
"""Of these, what tasks without walls and places do not have."""
NEGLIGIBLE = {"beyond_recorded": 0.01, "tries": 1.0}
"""Up to which value a measure is left out if no row has more; by default 0."""

COLUMNS = {
    "failed": ("failed", 2),
    "wall_contact": ("wall contact", 2),
    "steps": ("steps", 0),
    "distance": ("path length to success (m)", 1),
    "return": ("return", 1),
    "simulated_success": ("success in its simulator", 2),
    "simulated_steps": ("survived steps in its simulator", 0),
    "tries": ("training runs", 1),
    "beyond_recorded": ("beyond recorded commands", 2),
}
"""Column title and digits of such a measure."""


def render(results: Results, figures: Mapping[str, str]) -> str:
    """Return the page.

    Args:
        results: all numbers on it.
        figures: name → file name of each figure that was drawn; names as in `files.FIGURES`.
    """
    rows = results.methods
    seeds = ", ".join(map(str, results.seeds))
    if any(row.seeds != results.seeds for row in rows.values()):
        seeds += " (the table has the number of seeds of each row)"
    stages = [made for made in results.origins if made.machine and made.stages != ["report"]]
    reference = reference_of(rows)
    return fill(
        "recipe.md.jinja",
        results=results,
        figures=figures,
        rows=rows,
        seeds=seeds,
        headline=results.headline.measure,
        warning=warning(results),
        where=where(results),
        machines=machines(stages),
        scores=score_table(results),
        has_plus=any(map(is_plus, rows)),
        hand_written=hand_written(results),
        encoders=encoder_lines(results),
        horizons=horizon_titles(results),
        gaps=gap_tables(results),
        correlation=correlation_text,
        grounding=f"{method_title(reference)}'s, of the same seed" if reference else "each row's own",
        untested=[row.title for row in rows.values() if "raw" not in row.simulator_returns],
        choice=choice_values(results.choice),
        costed=COSTED,
        stage_costs=stage_costs(results),
        row_costs=row_costs(results),
        made=provenance(results.origins, results.own_code),
        datasets=dataset_lines(results),
    )


def hand_written(results: Results) -> str | None:
    """Return the title of a hand-written row that was tested in the grounded simulator, if there is one."""
    ceilings = [row for row in results.methods.values() if row.role == "ceiling" and row.simulated_success]
    return f"the {ceilings[0].title[0].lower()}{ceilings[0].title[1:]}" if ceilings else None


def score_table(results: Results) -> tuple[list[str], list[list[str]]]:
    """Return head and lines of the table of scores."""
    rows, scores = results.methods, results.scores
    beside = BESIDE.get(results.headline.measure, BESIDE["success"])
    bare = OF_PLANES | NEGLIGIBLE.keys() if results.tested_in == "target" else set(beside)
    beside = tuple(
        measure for measure in beside if measure not in bare or any(map(_some(measure), rows.values()))
    )
    best = {
        score: max((row.summary[score.measure].mean for row in rows.values() if not row.role), default=None)
        for score in scores
    }
    head = ["method", "seeds"]
    for score in scores:
        head += [score.title, "IQM [95 %]"]
    head += [COLUMNS[measure][0] for measure in beside]
    lines = []
    for row in rows.values():
        cells = [f"{row.title} ({row.role})" if row.role else row.title, str(len(row.seeds))]
        for score in scores:
            summary = row.summary[score.measure]
            mean = spread(summary, score.digits)
            cells.append(f"**{mean}**" if not row.role and summary.mean == best[score] else mean)
            cells.append(interval(summary.iqm, summary.low, summary.high, score.digits))
        cells += [
            spread(row.summary[measure], COLUMNS[measure][1]) if measure in row.summary else "-"
            for measure in beside
        ]
        lines.append(cells)
    paper = results.paper_success
    if paper:
        place = head.index(SUCCESS.title) + 1
        head.insert(place, "paper")
        for method, cells in zip(rows, lines, strict=True):
            cells.insert(place, f"{paper[method]:.2f}" if method in paper else "-")
    return head, lines


def _some(measure: str) -> Callable[[MethodResults], bool]:
    """Return whether a row has values of a measure to speak of: a robot without walls touches none."""
    least = NEGLIGIBLE.get(measure, 0.0)
    return lambda row: measure in row.summary and abs(row.summary[measure].mean) > least


def encoder_lines(results: Results) -> list[list[str]]:
    """Return the scores by encoder of the rows that have several."""
    return [
        [row.title, encoder, *(mean_std(values[score.measure], score.digits) for score in results.scores)]
        for row in results.methods.values()
        for encoder, values in row.encoders.items()
        if len(row.encoders) > 1
    ]


def horizon_titles(results: Results) -> list[str]:
    """Return the head of the tables of `gap_tables` behind their first column."""
    every = [gap.horizons for gap in results.gaps().values()]
    return [f"{steps} step{'s' if steps > 1 else ''}" for steps in (shared_horizons(every) if every else ())]


def gap_tables(results: Results) -> dict[str, list[list[str]]]:
    """Return quantity → lines of the table of open-loop errors, the raw simulator once if all share it."""
    gaps = {method_title(name): gap for name, gap in results.gaps().items()}
    if not gaps:
        return {}
    first = next(iter(gaps.values()))
    horizons = shared_horizons([gap.horizons for gap in gaps.values()])

    def cells(gap: GapMeans, band: BandMeans) -> list[str]:
        return [measured(*gap.at(band, horizon)) for horizon in horizons]

    tables = {}
    for quantity in first.grounded:
        raw = {title: cells(gap, gap.raw[quantity]) for title, gap in gaps.items()}
        shared = len(set(map(tuple, raw.values()))) == 1
        lines = [["Standing still", *cells(first, first.still[quantity])]] if first.still else []
        lines += [["No grounding", *next(iter(raw.values()))]] if shared else []
        for title, gap in gaps.items():
            if not shared:
                lines.append([f"{title}, no grounding", *raw[title]])
            lines.append([f"{title}, grounded", *cells(gap, gap.grounded[quantity])])
        tables[quantity] = lines
    return tables


def correlation_text(found: Correlation | None) -> str:
    """Return a coefficient with its interval; a dash where it is undefined."""
    return interval(found.value, found.low, found.high) if found else "-"
