"""How far from the best policy a choice is, by the trials in the target that it is given; print Markdown.

    uv run python tools/check_trials.py recipes/results/antmaze_long_fresh.json runs/cart/report/results.json

The target episodes of a report's policies are the pool that trials are drawn from, and their share of success
is taken for the truth, so the report needs a choice and a target.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from door import run_tool
from trial_regret import Pool, at_random, by_equal_shares, by_halving, estimate, pools_of

from astra_data.reports.files import read_published
from astra_data.reports.formatting import interval, table
from astra_data.reports.sizes import by_size

WAYS = {"halving from the prediction": by_halving, "equal shares": by_equal_shares, "at random": at_random}


def main(
    reports: Annotated[list[Path], typer.Argument(help="JSON files of reports.")],
    trials: Annotated[list[int] | None, typer.Option(help="Numbers of trials.")] = None,
    repeats: Annotated[int, typer.Option(help="Of the draw of outcomes.")] = 1000,
    resamples: Annotated[int, typer.Option(help="Of the seeds, for the intervals.")] = 200,
) -> None:
    """Print a table for each report and size."""
    counts = (0, *(trials or (10, 20, 50, 100, 200)))
    for report in reports:
        for percent, results in by_size(read_published(report)).items():
            pools = pools_of(results)
            size = f", {percent} %" if percent else ""
            head = f"{results.recipe}{size}: {len(pools)} candidates, regret by trials, 95 % over seeds"
            lines = [line(pools, count, repeats, resamples) for count in counts]
            print(f"{head}\n\n{table(['trials', *WAYS], lines)}\n", flush=True)


def line(pools: Sequence[Pool], count: int, repeats: int, resamples: int) -> list[str]:
    """Return a line of the table: the regret of each way with so many trials."""
    found = [estimate(pools, count, choose, repeats=repeats, resamples=resamples) for choose in WAYS.values()]
    return [f"{count}", *(interval(one.mean, one.low, one.high) for one in found)]


if __name__ == "__main__":
    run_tool(main)
