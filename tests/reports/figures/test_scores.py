from itertools import pairwise

import numpy as np
import pytest
from figures_shown import legend
from matplotlib.colors import to_hex
from matplotlib.text import Text

from astra_data.reports.figures.scores import Curve, learning_curves, score_bars
from astra_data.reports.figures.style import method_color
from astra_data.worlds.score import SUCCESS, SURVIVED_STEPS, Score


def test_success_bars_show_bars_seeds_and_intervals() -> None:
    scores = {"nas": np.array([0.2, 0.4, 0.3]), "astra_plus": np.array([0.8]), "follower": np.array([1.0])}
    intervals = {
        "nas": (0.3, 0.2, 0.4),
        "astra_plus": (0.8, np.nan, np.nan),
        "follower": (1.0, np.nan, np.nan),
    }
    figure = score_bars(SUCCESS, scores, intervals, {"nas": 0.9, "astra_plus": 0.95})
    axes = figure.axes[0]
    assert [bar.get_width() for bar in axes.patches] == [0.3, 0.8, 1.0]  # type: ignore[attr-defined]
    assert [bool(bar.get_hatch()) for bar in axes.patches] == [False, True, False]
    assert [to_hex(bar.get_facecolor()) for bar in axes.patches] == [method_color(row) for row in scores]
    dots = [line for line in axes.lines if line.get_marker() == "o"]
    assert [sorted(np.asarray(line.get_xdata())) for line in dots] == [[0.2, 0.3, 0.4], [0.8], [1.0]]
    assert sum(line.get_marker() == "D" for line in axes.lines) == 2
    assert not any(line.get_clip_on() for line in axes.lines if line.get_marker() in ("o", "D"))
    assert sum(line.get_marker() == "None" for line in axes.lines) == 1  # one interval
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["NAS", "ASTRA+", "Careful follower (ceiling)"]
    assert axes.yaxis_inverted()  # the first row on top
    assert [text.get_text() for text in axes.texts] == ["0.30", "0.80", "1.00"]
    assert "in its own simulator" in legend(figure)


def test_survived_steps_have_no_limit_and_no_decimals() -> None:
    steps = {"nas": np.array([63.0, 61.4]), "astra": np.array([310.0])}
    intervals = {"nas": (62.2, 61.4, 63.0), "astra": (310.0, np.nan, np.nan)}
    axes = score_bars(SURVIVED_STEPS, steps, intervals, {"astra": 1000.0}).axes[0]
    left, right = axes.get_xlim()
    assert left == 0 and 1000 < right < 1100
    assert axes.get_xlabel() == "number of survived steps in the target"
    assert [text.get_text() for text in axes.texts] == ["62", "310"]
    curve = Curve(np.array([0.0, 100.0]), np.array([20.0, 400.0]))
    figure = learning_curves(SURVIVED_STEPS, {"nas": [curve]})
    low, high = figure.axes[0].get_ylim()
    assert low == 0 and 400 < high < 450
    assert figure.get_supylabel() == "survived steps of training\nepisodes, from all starts"


def test_learning_curves_average_over_seeds_on_steps_that_all_have() -> None:
    curves = {
        "nas": [
            Curve(np.array([0.0, 100.0]), np.array([0.0, 1.0])),
            Curve(np.array([0.0, 50.0, 200.0]), np.array([np.nan, 0.5, 0.5])),
        ],
        "nas_plus": [Curve(np.array([0.0, 100.0]), np.array([0.2, 0.4]))],
        "astra_plus": [Curve(np.array([0.0, 100.0]), np.array([0.2, 0.4]))],
    }
    figure = learning_curves(SUCCESS, curves)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["NAS", "ASTRA"]
    first, second = figure.axes
    assert legend(figure) == ["without the [plus] settings", "with the [plus] settings"]
    assert (len(first.collections), len(second.collections)) == (1, 0)  # a band needs two seeds
    (nas, nas_plus), (astra,) = first.lines, second.lines
    assert nas_plus.get_linestyle() == "--"
    assert (nas.get_linestyle(), astra.get_linestyle()) == ("-", "--")
    steps, success = np.asarray(nas.get_xdata()), np.asarray(nas.get_ydata())
    assert (steps[0], steps[-1]) == (50.0, 100.0)
    assert (success[0], success[-1]) == pytest.approx((0.5, 0.75))


def test_many_rows_get_a_panel_each_and_readable_bars() -> None:
    rows = [f"method_{number}" for number in range(14)]
    curve = Curve(np.array([0.0, 100.0]), np.array([0.2, 0.4]))
    figure = learning_curves(SUCCESS, {row: [curve] for row in rows})
    drawn = [axes for axes in figure.axes if axes.axison]
    assert [axes.get_title(loc="left") for axes in drawn] == [f"Method {number}" for number in range(14)]
    assert not figure.legends
    bars = score_bars(SUCCESS, dict.fromkeys(rows, np.ones(10)), dict.fromkeys(rows, (1.0, 0.9, 1.0)), {})
    bars.draw_without_rendering()
    labels = [label.get_window_extent() for label in bars.axes[0].get_yticklabels()]
    assert all(upper.y0 > lower.y1 for upper, lower in pairwise(labels))
    assert min(label.x0 for label in labels) >= 0


@pytest.mark.parametrize("rows", [("nas",), ("nas", "astra", "compass", "rma", "iql")])
@pytest.mark.parametrize("score", [SUCCESS, SURVIVED_STEPS])
def test_labels_of_learning_curves_lie_within_the_figure(score: Score, rows: tuple[str, ...]) -> None:
    curve = Curve(np.array([0.0, 1e6]), np.array([0.0, 1.0]))
    figure = learning_curves(score, {row: [curve] for row in rows})
    figure.canvas.draw()
    (label,) = [text for text in figure.findobj(Text) if text.get_text() == figure.get_supylabel()]
    box = label.get_window_extent()
    assert figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1 and box.x0 >= 0
