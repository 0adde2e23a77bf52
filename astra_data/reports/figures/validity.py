"""How well simulators predict returns in the target: one dot per policy."""

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from astra_data.core.naming import is_plus
from astra_data.reports.figures.scene import Scene
from astra_data.reports.figures.style import FAINT, method_color, method_title, style
from astra_data.reports.results import Results
from astra_data.reports.runs import SHARED_WORLDS


def predictive_validity(results: Results, _: Scene) -> Figure | None:
    """Draw the return in the target against that in each simulator; on the dashed line they are equal."""
    worlds = [world for world in SHARED_WORLDS if any(line.where == world for line in results.lines)]
    if results.tested_in != "target" or not worlds:
        return None
    rows = results.tested()
    with style():
        height = max(3.7, 0.6 + 0.19 * len(rows))
        figure = Figure(figsize=(2.4 + 3.0 * len(worlds), height), layout="constrained")
        grid = figure.subplots(1, len(worlds), squeeze=False, sharey=True)[0]
        for axes, world in zip(grid, worlds, strict=True):
            axes.axline((0, 0), slope=1, color=FAINT, ls="--", lw=0.9, zorder=1)
            for row in rows:
                target, there = results.values(row, "return"), results.values(row, "return", world)
                pairs = [(there[seed], target[seed]) for seed in there if seed in target]
                if pairs:
                    look = {"color": method_color(row), "mec": "white", "mew": 0.6, "ms": 6}
                    axes.plot(*zip(*pairs, strict=True), _marker(row), **look)
            axes.set_title(f"{world} simulator".capitalize(), loc="left")
            axes.set_xlabel("return in this simulator")
            axes.grid(visible=True, axis="both")
        grid[0].set_ylabel("return in the target")
        handles = [
            Line2D([], [], marker=_marker(row), ls="", color=method_color(row), mec="white", ms=6.5)
            for row in rows
        ]
        figure.legend(handles, [method_title(row) for row in rows], loc="outside right center")
        return figure


def _marker(row: str) -> str:
    return "^" if is_plus(row) else "o"
