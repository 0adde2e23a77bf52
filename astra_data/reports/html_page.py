"""Results → one HTML page that loads nothing; its text is in `templates/results.html.jinja`."""

import json
from base64 import b64encode
from collections.abc import Mapping, Sequence
from typing import Any

from astra_data.core.naming import is_plus, reference_of
from astra_data.methods import method_title
from astra_data.reports.choice_page import choice_values
from astra_data.reports.cost_and_origin import COSTED, dataset_lines, provenance, row_costs, stage_costs
from astra_data.reports.files import Found
from astra_data.reports.formatting import fill_html, inline
from astra_data.reports.losses import loss_head, losses, remaining_errors, seed_lines
from astra_data.reports.page import correlation_text, encoder_lines, gap_tables, horizon_titles, score_table
from astra_data.reports.schema import Origin, Results
from astra_data.reports.sizes import SizesResults, size_head, size_lines, unfinished
from astra_data.reports.tested import warning, where
from astra_data.reports.verdict import verdict_of
from astra_data.worlds.score import Score

HTML = "results.html"
LEAST_POLICIES = 5
"""Policies below which no correlation over them is shown."""
_FORESIGHT = (
    "failures",
    "AUC 1\N{EN DASH}20 steps",
    "11\N{EN DASH}30",
    "21\N{EN DASH}40",
    "Brier skill",
    "observed of predicted",
)
_PIXEL = 2
"""Pixels of a figure for each of the page."""
_SIZE = slice(16, 24)
"""Where a PNG has its width and height."""


def render_html(found: Found, images: Mapping[str, bytes], foresight: Sequence[Sequence[str]] = ()) -> str:
    """Return the page.

    Args:
        found: all numbers on it.
        images: name → PNG; names as in `files.FIGURES`, and "reliability".
        foresight: lines of how well failures are foreseen, as `held_out.foresight_lines` returns them.
    """
    sized = max(found.sizes, key=lambda size: size.percent) if isinstance(found, SizesResults) else None
    results = sized.results if sized else found
    assert isinstance(results, Results)
    every = [size.results for size in found.sizes] if isinstance(found, SizesResults) else [results]
    percent = sized.percent if sized else None
    figures = {name: _figure(image) for name, image in images.items()}
    few = {
        name: of.policies for name, of in results.predictive_validity.items() if of.policies < LEAST_POLICIES
    }
    if few:
        figures.pop("validity", None)
    scores = [score.measure for score in results.scores]
    return fill_html(
        "results.html.jinja",
        results=results,
        command=found.command,
        recipe=found.recipe,
        percent=percent,
        verdict=verdict_of(results, percent),
        warning=inline(warning(results)),
        where=where(results),
        unfinished=unfinished(found) if isinstance(found, SizesResults) else ", ".join(results.unfinished),
        figures=figures,
        pictured=not figures.keys().isdisjoint({"trajectories", "strips", *scores}),
        score_alts={score.measure: _alt(results, score) for score in results.scores},
        headline=results.headline,
        loss_head=loss_head(results),
        losses=losses(results),
        single=[row.title for row in results.methods.values() if len(row.seeds) == 1],
        comparisons=_comparisons(results),
        errors=_errors(results),
        gaps=gap_tables(results),
        horizons=horizon_titles(results),
        validity=[
            [name, f"{of.policies}", correlation_text(of.pearson), correlation_text(of.spearman)]
            for name, of in results.predictive_validity.items()
            if name not in few
        ],
        few_policies=few,
        least_policies=LEAST_POLICIES,
        reference=method_title(reference) if (reference := reference_of(results.methods)) else None,
        foresight=foresight,
        foresight_head=[*(["size"] if sized else []), "simulator", *_FORESIGHT],
        sizes=_sizes(found) if isinstance(found, SizesResults) else None,
        choice=choice_values(results.choice, shown=None),
        scores=_plain(score_table(results)),
        seed_lines=seed_lines(results),
        encoders=encoder_lines(results),
        costed=COSTED,
        stage_costs=stage_costs(results),
        row_costs=row_costs(results),
        made={what: inline(text) for what, text in provenance(_origins(every), results.own_code).items()},
        datasets=[
            inline(line) for line in dict.fromkeys(line for one in every for line in dataset_lines(one))
        ],
        settings=json.dumps(results.settings, indent=2, ensure_ascii=False),
        has_plus=any(map(is_plus, results.methods)),
    )


def _figure(image: bytes) -> dict[str, Any]:
    """Return what the page says of a PNG: its address, and its size in CSS pixels."""
    size = image[_SIZE]
    width, height = (int.from_bytes(of) // _PIXEL for of in (size[:4], size[4:]))
    return {"src": f"data:image/png;base64,{b64encode(image).decode()}", "width": width, "height": height}


def _alt(results: Results, score: Score) -> str:
    """Return what the bars of a score show, in words."""
    rows = results.methods.values()
    return ", ".join(f"{row.title} {score.text(row.summary[score.measure].iqm)}" for row in rows)


def _comparisons(results: Results) -> list[list[str]]:
    """Return the comparisons of rows that have an interval, and so more than one seed."""
    rows, digits = results.methods, results.headline.digits
    return [
        [
            rows[ours].title,
            rows[other].title,
            f"{of.probability:.2f}",
            f"[{of.low:.2f}, {of.high:.2f}]",
            f"{by.mean:.{digits}f}" if (by := of.difference) else "-",
            f"[{by.low:.{digits}f}, {by.high:.{digits}f}]" if by else "-",
        ]
        for ours, others in results.probability_of_improvement.items()
        for other, of in others.items()
        if of.low is not None
    ]


def _errors(results: Results) -> dict[str, Any] | None:
    if not results.gaps():
        return None
    horizon, groundings, lines = remaining_errors(results)
    return {"horizon": horizon, "head": ["quantity", *map(method_title, groundings)], "lines": lines}


def _sizes(found: SizesResults) -> dict[str, Any]:
    means, intervals = size_lines(found)
    return {"head": size_head(found), "means": means, "intervals": intervals}


def _origins(every: Sequence[Results]) -> list[Origin]:
    return [origin for results in every for origin in results.origins]


def _plain(found: tuple[list[str], list[list[str]]]) -> tuple[list[str], list[list[str]]]:
    """Return a table of a Markdown page without the marks of bold cells."""
    head, lines = found
    return head, [[cells[0], *(cell.replace("**", "") for cell in cells[1:])] for cells in lines]
