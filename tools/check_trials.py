"""How far from the best policy a choice is, by the trials in the target that it is given; print Markdown.

    uv run python tools/check_trials.py runs/antmaze_long runs/cart_study

The recorded target episodes of a run's policies are the pool that trials are drawn from, and their share of
success is taken for the truth, so the run has to be made until `evaluate`, and to have a choice.
"""

from pathlib import Path
from typing import Annotated

import typer

from astra_data.experiments.trial_regret import (
    at_random,
    by_equal_shares,
    by_halving,
    estimate,
    pools_of,
)
from astra_data.reports.choice import read_judged
from astra_data.reports.formatting import interval, table

WAYS = {"halving from the prediction": by_halving, "equal shares": by_equal_shares, "at random": at_random}


def main(
    runs: Annotated[list[Path], typer.Argument(help="Folders of runs.")],
    trials: Annotated[list[int] | None, typer.Option(help="Numbers of trials.")] = None,
    repeats: Annotated[int, typer.Option(help="Of the draw of outcomes.")] = 1000,
    resamples: Annotated[int, typer.Option(help="Of the seeds, for the intervals.")] = 200,
) -> None:
    """Print a table for each run and size."""
    for run in runs:
        judged = read_judged(run)
        for percent in judged.percents if judged else [None]:
            pools = pools_of(run, percent)
            size = f", {percent} %" if percent else ""
            print(f"{run.name}{size}: {len(pools)} candidates, regret by trials, 95 % over seeds\n")
            lines = []
            for count in (0, *(trials or (10, 20, 50, 100, 200))):
                found = [
                    estimate(pools, count, choose, repeats=repeats, resamples=resamples)
                    for choose in WAYS.values()
                ]
                lines.append([f"{count}", *(interval(one.mean, one.low, one.high) for one in found)])
            print(table(["trials", *WAYS], lines) + "\n", flush=True)


if __name__ == "__main__":
    typer.run(main)
