import numpy as np
from figures_shown import legend

from astra_data.reports.figures.open_loop import OpenLoop, open_loop_error


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


def test_raw_simulators_that_differ_are_all_drawn_and_units_follow_from_the_names() -> None:
    horizons, band = np.array([1.0, 10.0]), np.ones((3, 2))
    names = ("turn_rate_rad_s", "speed_m_s", "push_m_s2", "heading_rad", "tilt_deg", "energy")
    same = dict.fromkeys(names, band)
    figure = open_loop_error(
        {
            "nas": OpenLoop(horizons, same, same),
            "astra": OpenLoop(horizons, same, dict.fromkeys(names, 1.005 * band)),
            "iql": OpenLoop(horizons, same, dict.fromkeys(names, 1.03 * band)),
        }
    )
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "turn rate error (rad/s)",
        "speed error (m/s)",
        "push error (m/s²)",
        "heading error (rad)",
        "tilt error (°)",
        "energy error",
    ]
    dotted = [line for line in figure.axes[0].lines if line.get_linestyle() == ":"]
    assert [float(np.asarray(line.get_ydata())[0]) for line in dotted] == [1.0, 1.03]
    assert legend(figure).count("no grounding") == 1
