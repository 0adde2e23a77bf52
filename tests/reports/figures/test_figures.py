from io import BytesIO
from itertools import pairwise

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread

from astra_data.methods import METHODS
from astra_data.reports.figures import (
    Curve,
    Foretold,
    OpenLoop,
    Panel,
    Strip,
    Visits,
    coverage,
    data_efficiency,
    dynamics_mismatch,
    learning_curves,
    method_colour,
    method_title,
    open_loop_error,
    png,
    predictive_validity,
    score_bars,
    strips,
    trajectories,
)
from astra_data.reports.figures.style import DEPLOYED, SIMULATED, style
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.score import SUCCESS, SURVIVED_STEPS

ROWS = ("direct_transfer", "nas", "astra", "direct_transfer_plus", "nas_plus", "astra_plus", "follower")


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def panel(method: str, *, in_simulator: bool = True) -> Panel:
    target = np.full((3, 10, 2), np.nan)
    target[0] = np.linspace([-4, 4], [4, 4], 10)
    target[1, :4] = np.linspace([-4, 4], [0, 4], 4)
    target[2, :6] = np.linspace([-4, 4], [1, 4], 6)
    simulated = target[:1] if in_simulator else np.empty((0, 1, 2))
    return Panel(
        method=method,
        success=1 / 3,
        target=target,
        target_success=np.array([True, False, False]),
        simulated=simulated,
        simulated_success=np.ones(len(simulated), dtype=bool),
        goal=np.full((3, 2), -4.0),
    )


def test_titles_follow_from_the_names() -> None:
    assert [method_title(row) for row in ROWS] == [
        "Direct transfer",
        "NAS",
        "ASTRA",
        "Direct transfer+",
        "NAS+",
        "ASTRA+",
        "Careful follower",
    ]
    assert method_title("my_own_plus") == "My own+"


def test_every_row_has_its_own_colour_and_a_plus_row_its_base_rows_darker() -> None:
    assert len({method_colour(row) for row in ROWS}) == len(ROWS)
    for base in (*METHODS, "my_own"):
        light, dark = to_rgb(method_colour(base)), to_rgb(method_colour(f"{base}_plus"))
        assert sum(dark) < sum(light)
        assert dark == pytest.approx([0.68 * channel for channel in light], abs=0.01)
    assert method_colour("my_own") == method_colour("my_own")


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
    assert [to_hex(bar.get_facecolor()) for bar in axes.patches] == [method_colour(row) for row in scores]
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
    assert figure.get_supylabel() == "survived steps of training episodes, from all starts"


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
    assert legend(figure) == ["without the [plus] settings", "with them"]
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


def test_validity_draws_a_dot_per_policy_in_its_rows_colour() -> None:
    returns = {"nas": np.array([[1.0, 2.0], [3.0, 4.0]]), "astra_plus": np.array([[5.0], [6.0]])}
    figure = predictive_validity([Foretold("Raw simulator", returns), Foretold("Grounded", {})])
    raw, grounded = figure.axes
    assert (raw.get_title(loc="left"), grounded.get_title(loc="left")) == ("Raw simulator", "Grounded")
    assert legend(figure) == ["NAS", "ASTRA+"]
    equal, nas, astra = raw.lines
    assert equal.get_linestyle() == "--"
    assert [np.asarray(axis).tolist() for axis in nas.get_data()] == [[1.0, 2.0], [3.0, 4.0]]
    assert [line.get_color() for line in (nas, astra)] == [method_colour("nas"), method_colour("astra_plus")]
    assert nas.get_marker() != astra.get_marker()
    assert len(grounded.lines) == 1
    assert png(figure).startswith(b"\x89PNG")


def test_trajectories_draw_a_panel_per_row_with_crosses_where_episodes_fail() -> None:
    figure = trajectories(U_MAZE, [panel("astra"), panel("follower", in_simulator=False)])
    astra, follower = figure.axes
    assert (astra.get_title(loc="left"), astra.get_title(loc="right")) == ("ASTRA", "0.33")
    assert follower.get_title(loc="left") == "Careful follower"
    paths = [line for line in astra.lines if line.get_linestyle() != "None"]
    looks = [(line.get_color(), line.get_linestyle()) for line in paths]
    assert looks == [(DEPLOYED, "-")] * 3 + [(SIMULATED, "--")]
    crosses = [line for line in astra.lines if line.get_marker() == "x" and line.get_color() == DEPLOYED]
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in crosses] == [(0.0, 4.0), (1.0, 4.0)]  # type: ignore[index]
    assert sum(line.get_marker() == "*" for line in astra.lines) == 1
    assert not [line for line in follower.lines if line.get_color() == SIMULATED]
    (walls,) = astra.collections
    assert len(walls.get_paths()) == len(U_MAZE.wall_cells())


def test_strips_have_a_picture_for_each_moment_until_the_end() -> None:
    pictures = np.zeros((3, 8, 6, 3), dtype=np.uint8)
    figure = strips(
        (0.0, 1.0, 5.0),
        {"nas": Strip(pictures[:2], ended_s=1.34, failed=True), "astra": Strip(pictures, 5.0, failed=False)},
    )
    figure.canvas.draw()
    assert [len(axes.images) for axes in figure.axes] == [1, 1, 0, 1, 1, 1]
    assert [axes.get_title() for axes in figure.axes[:3]] == ["0 s", "1 s", "5 s"]
    told = [[text.get_text() for text in axes.texts] for axes in figure.axes[::3]]
    assert told == [["NAS", "fell after 1.3 s"], ["ASTRA", "5 s"]]


def test_dynamics_mismatch_draws_mean_and_two_bands_for_x_y_and_speed() -> None:
    time_s = np.array([0.0, 0.1, 0.2, 0.3, 0.4])
    simulated = np.tile([1.0, 2.0, 3.0, 4.0], (5, 1))
    target = np.stack([simulated, simulated + 1])
    target[1, 4] = np.nan
    figure = dynamics_mismatch(time_s, np.zeros((5, 2)), simulated, target)
    x, y, speed, command = figure.axes
    labels = [axes.get_ylabel() for axes in (x, y, speed, command)]
    assert labels == ["x (m)", "y (m)", "speed (m/s)", "command (±1 per axis)"]
    for axes in (x, y, speed):
        assert len(axes.collections) == 2
        assert len(axes.lines) == 2
    # A command holds during the step that ends at its time.
    assert [line.get_drawstyle() for line in command.lines] == ["steps-pre"] * 2
    mean, one = x.lines
    assert np.asarray(mean.get_ydata()).tolist() == [1.5, 1.5, 1.5, 1.5, 1.0]
    assert [to_hex(str(line.get_color())) for line in (mean, one)] == [DEPLOYED.lower(), SIMULATED.lower()]
    assert np.asarray(speed.lines[1].get_ydata()).tolist() == [5.0] * 5


def test_open_loop_error_is_logarithmic_and_draws_a_shared_raw_simulator_once() -> None:
    horizons = np.array([1.0, 10.0])
    grounded = {"position_m": np.array([[0.1, 0.2], [0.05, 0.1], [0.2, 0.4]])}
    raw = {"position_m": np.array([[1.0, 2.0], [0.5, 1.0], [2.0, 4.0]])}
    gaps = {name: OpenLoop(horizons, grounded, raw) for name in ("nas", "astra")}
    figure = open_loop_error(gaps)
    (axes,) = figure.axes
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert axes.get_ylabel() == "position error (m)"
    assert legend(figure) == ["no grounding", "NAS", "ASTRA"]
    assert np.asarray(axes.lines[0].get_ydata()).tolist() == [1.0, 2.0]
    assert len(axes.collections) == 3


def test_drawing_leaves_the_callers_settings_alone_and_needs_no_display(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    before = dict(matplotlib.rcParams)
    image = png(score_bars(SUCCESS, {"nas": np.array([0.5])}, {"nas": (0.5, np.nan, np.nan)}, {}))
    assert image.startswith(b"\x89PNG")
    assert dict(matplotlib.rcParams) == before


def test_a_palette_keeps_the_colours_of_methods() -> None:
    scores = {method: np.array([0.5]) for method in ROWS}
    figure = score_bars(SUCCESS, scores, {method: (0.5, np.nan, np.nan) for method in ROWS}, {})
    everything = BytesIO()
    with style():
        figure.savefig(everything, format="png")
    small = png(figure)
    assert len(small) < 0.5 * len(everything.getvalue())
    drawn = imread(BytesIO(everything.getvalue()))[..., :3]
    np.testing.assert_allclose(imread(BytesIO(small))[..., :3], drawn, atol=0.07)


def test_only_visited_cells_are_coloured() -> None:
    counts = np.array([[0, 3], [40, 0], [1, 0]])
    figure = coverage(counts, (-1.0, 1.0, 0.0, 3.0), "position", "m")
    axes = figure.axes[0]
    (image,) = axes.images
    shown = image.get_array()
    assert isinstance(shown, np.ma.MaskedArray)
    np.testing.assert_array_equal(shown.mask, counts == 0)
    assert image.origin == "lower"
    assert (axes.get_xlim(), axes.get_ylim()) == ((-1.0, 1.0), (0.0, 3.0))
    assert axes.get_xlabel() == "x position (m)"
    assert png(figure).startswith(b"\x89PNG")


def test_data_efficiency_has_a_map_per_size_and_a_band_per_row() -> None:
    visits = [Visits(np.full((2, 3), count), (0.0, 3.0, 0.0, 2.0)) for count in (4, 1, 9)]
    # One size has a seed less than the others.
    scores = {"nas": [np.array([0.6, 0.8]), np.array([0.2]), np.array([0.7, 0.9])]}
    intervals = {"nas": np.array([[0.7, 0.1, 0.8], [0.6, 0.0, 0.7], [0.8, 0.3, 0.9]])}
    figure = data_efficiency(SUCCESS, [100, 25, 150], scores, intervals, {"position (m)": visits})
    *maps, success = figure.axes
    # Sizes are in order, however they are given.
    assert [axes.get_title() for axes in maps] == ["25 %", "100 %", "150 %"]
    assert [axes.images[0].get_array().max() for axes in maps] == [1, 4, 9]  # type: ignore[union-attr]
    line = success.lines[0]
    assert np.array(line.get_xdata()).tolist() == [25, 100, 150]
    assert np.array(line.get_ydata()).tolist() == [0.1, 0.7, 0.8]
    assert len(success.collections) == 1
    alone = {"nas": np.full((3, 3), np.nan)}
    assert not data_efficiency(SUCCESS, [100, 25, 150], scores, alone, {}).axes[0].collections
    other = data_efficiency(SURVIVED_STEPS, [100, 25, 150], scores, alone, {}).axes[0]
    assert (success.get_ylim(), other.get_ylim()[0]) == ((-0.02, 1.02), 0.0)
    assert success.get_ylabel() == "success rate in the target" != other.get_ylabel()
    assert png(figure)
