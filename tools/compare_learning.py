"""Draw the learning curves of two published results over each other: what a change to the trainings did.

    uv run python tools/compare_learning.py recipes/results/antmaze_long.json \
        recipes/results/antmaze_long_fresh.json --out learning.png

A panel for each row that both have. Lines are means over seeds, bands go from the worst seed to the best.
"""

from pathlib import Path
from typing import Annotated

import typer
from door import run_tool
from matplotlib.figure import Figure

from astra_data.reports.drawing import training_curves
from astra_data.reports.figures.scores import on_one_grid
from astra_data.reports.figures.style import FAINT, INK, method_title, score_axis, style
from astra_data.reports.files import read_published
from astra_data.reports.schema import Results


def main(
    before: Annotated[Path, typer.Argument(help="Published results, JSON.")],
    after: Annotated[Path, typer.Argument(help="Others, of the same task.")],
    out: Annotated[Path, typer.Option(help="PNG file.")],
) -> None:
    """Draw the figure and print the mean score of each row at the end."""
    found = [read_published(path) for path in (before, after)]
    results = [one for one in found if isinstance(one, Results)]
    if len(results) < 2:
        raise typer.BadParameter("expected results of recipes without a sweep")
    curves = [training_curves(one) for one in results]
    rows = [row for row in curves[1] if row in curves[0]]
    if not rows:
        raise typer.BadParameter(f"expected a row that both have trained, got none in {before} and {after}")
    with style():
        figure = Figure(figsize=(0.6 + 2.2 * len(rows), 2.6), layout="constrained")
        for axes, row in zip(figure.subplots(1, len(rows), squeeze=False, sharey=True)[0], rows, strict=True):
            axes.set_title(method_title(row), loc="left")
            for one, of_rows, color in zip(results, curves, (FAINT, INK), strict=True):
                steps, scores = on_one_grid(of_rows[row])
                low, high = scores.min(axis=0), scores.max(axis=0)
                axes.fill_between(steps / 1e6, low, high, color=color, alpha=0.2, lw=0)
                axes.plot(steps / 1e6, scores.mean(axis=0), color=color, label=one.recipe)
                print(f"{row}: {one.recipe} {scores[:, -1].mean():.2f} of {len(scores)} trainings")
        score_axis(figure.axes[0], results[1].headline)
        figure.supxlabel("million steps of training")
        figure.supylabel(f"{results[1].headline.title} of training episodes")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
        figure.savefig(out)


if __name__ == "__main__":
    run_tool(main)
