"""The finished points of a sweep as a table for the terminal."""

from collections import defaultdict
from collections.abc import Collection, Mapping

from rich.table import Table

from astra_data.experiments.points import RunPoint
from astra_data.methods import method_title
from astra_data.worlds.score import Score


def board(points: Collection[RunPoint], means: Mapping[RunPoint, float], score: Score) -> Table:
    """Draw methods by sizes, or by seeds where there are no sizes.

    Args:
        points: all of the sweep, in the order of the table.
        means: of the score over the episodes of each point that is finished.
        score: that is shown.
    """
    has_sizes = len({point.percent for point in points}) > 1
    columns: dict[str, list[RunPoint]] = defaultdict(list)
    for point in points:
        columns[f"{point.percent} %" if has_sizes else f"seed {point.seed}"].append(point)
    table = Table(title=progress_text(points, means), title_justify="left")
    table.add_column("method")
    for column in columns:
        table.add_column(column, justify="right")
    for method in dict.fromkeys(point.method for point in points):
        cells = ([point for point in column if point.method == method] for column in columns.values())
        table.add_row(method_title(method), *(_cell(cell, means, score) for cell in cells))
    return table


def progress_text(points: Collection[RunPoint], means: Mapping[RunPoint, float]) -> str:
    """Return how many of the points are finished."""
    return f"{sum(point in means for point in points)} of {len(points)} points"


def _cell(points: Collection[RunPoint], means: Mapping[RunPoint, float], score: Score) -> str:
    """Return the score of a point; of several, how many are done, and their mean score; nothing of none."""
    done = [means[point] for point in points if point in means]
    count = "" if len(points) < 2 else f"{len(done)} of {len(points)} "
    mean = f" {score.text(sum(done) / len(done))}" if done else ""
    return f"{count}done{mean}" if count or done else ""
