import numpy as np
from matplotlib.figure import Figure

from astra_data.reports.figures.walks import walk_prediction

ERRORS = {
    "raw": np.array([[0.1, 0.4], [0.05, 0.3], [0.2, 0.5]]),
    "astra": np.array([[0.05, 0.2], [0.04, 0.1], [0.06, 0.3]]),
}
LOOKS = {"raw": ("Raw simulator", "#2b2b2b"), "astra": ("ASTRA", "#009e73")}


def drawn(minutes: list[float]) -> Figure:
    by_horizon = {"forward_m": ERRORS, "turn_rad": ERRORS}
    by_minutes = {
        axis: {name: band[:, ::-1] for name, band in bands.items()} for axis, bands in by_horizon.items()
    }
    return walk_prediction([0.5, 1.0], by_horizon, minutes, by_minutes, 1.0, LOOKS)


def test_each_axis_has_a_panel_by_horizon_and_one_by_minutes_below() -> None:
    figure = drawn([2.0, 8.0])
    forward, turn, below, _ = figure.axes
    assert [axes.get_title() for axes in (forward, turn)] == ["forward (m)", "turn (rad)"]
    assert [axes.get_ylabel() for axes in (forward, below)] == ["RMS error", "RMS error after 1 s"]
    raw, astra = forward.lines
    assert (raw.get_linestyle(), astra.get_linestyle()) == (":", "-")
    assert np.asarray(raw.get_xydata()).tolist() == [[0.5, 0.1], [1.0, 0.4]]
    assert np.asarray(below.lines[1].get_xydata()).tolist() == [[2.0, 0.2], [8.0, 0.05]]
    assert below.get_xscale() == "log"
    assert [label.get_text() for label in below.get_xticklabels()] == ["2", "8"]
    band = forward.collections[1].get_paths()[0].vertices
    assert (np.asarray(band)[:, 1].min(), np.asarray(band)[:, 1].max()) == (0.04, 0.3)
    assert forward.get_ylim()[0] == 0
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["Raw simulator", "ASTRA"]


def test_a_single_amount_of_data_needs_no_lower_row() -> None:
    assert len(drawn([8.0]).axes) == 2
