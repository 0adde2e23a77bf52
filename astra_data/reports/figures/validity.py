"""How well simulators predict returns in the target: one dot per policy."""

from collections.abc import Mapping
from dataclasses import dataclass

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from astra_data.core.arrays import Floats
from astra_data.core.naming import is_plus
from astra_data.reports.figures.style import FAINT, method_color, method_title, style


@dataclass(frozen=True)
class SimulatorReturns:
    """Returns in one simulator and in the target.

    Attributes:
        title: of the panel.
        returns: row → mean returns of its seeds' policies in the simulator and in the target, (2, seeds).
    """

    title: str
    returns: Mapping[str, Floats]


def predictive_validity(simulators: list[SimulatorReturns]) -> Figure:
    """Draw the return in the target against that in each simulator; on the dashed line they are equal."""
    rows = list(dict.fromkeys(row for simulator in simulators for row in simulator.returns))
    with style():
        height = max(3.7, 0.6 + 0.19 * len(rows))
        figure = Figure(figsize=(2.4 + 3.0 * len(simulators), height), layout="constrained")
        grid = figure.subplots(1, len(simulators), squeeze=False, sharey=True)[0]
        for axes, simulator in zip(grid, simulators, strict=True):
            axes.axline((0, 0), slope=1, color=FAINT, ls="--", lw=0.9, zorder=1)
            for row, (simulated, target) in simulator.returns.items():
                axes.plot(
                    simulated, target, _marker(row), color=method_color(row), mec="white", mew=0.6, ms=6
                )
            axes.set_title(simulator.title, loc="left")
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
