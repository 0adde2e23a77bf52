from pathlib import Path

import numpy as np
from figures_shown import legend

from astra_data.reports.figures.open_loop import open_loop_error
from astra_data.reports.figures.scene import Scene
from astra_data.reports.results import Errors, Results
from astra_data.robots.registry import TASKS

SCENE = Scene(Path(), TASKS["antmaze-umaze"])


def results(raw: dict[str, float], *quantities: str) -> Results:
    errors = [
        Errors(
            row=row,
            seed=0,
            simulator=simulator,
            quantity=quantity,
            horizons=[1, 10],
            mean=[factor * scale, 2 * factor * scale],
            low=[0.5 * factor * scale, factor * scale],
            high=[2 * factor * scale, float("nan")],
        )
        for row, scale in raw.items()
        for simulator, factor in (("raw", 1.0), ("grounded", 0.1))
        for quantity in quantities
    ]
    return Results(recipe="r", task="t", command="", rows=("nas", "astra", "iql"), episodes=1, errors=errors)


def test_open_loop_error_is_logarithmic_and_draws_a_shared_raw_simulator_once() -> None:
    figure = open_loop_error(results({"nas": 1.0, "astra": 1.0}, "position_m"), SCENE)
    assert figure is not None
    (axes,) = figure.axes
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert axes.get_ylabel() == "position error (m)"
    assert legend(figure) == ["no grounding", "NAS", "ASTRA"]
    assert np.asarray(axes.lines[0].get_xydata()).tolist() == [[1.0, 1.0], [10.0, 2.0]]
    assert len(axes.collections) == 3
    assert open_loop_error(results({}), SCENE) is None


def test_raw_simulators_that_differ_are_all_drawn_and_units_follow_from_the_names() -> None:
    names = ("turn_rate_rad_s", "speed_m_s", "push_m_s2", "heading_rad", "tilt_deg", "energy")
    figure = open_loop_error(results({"nas": 1.0, "astra": 1.005, "iql": 1.03}, *names), SCENE)
    assert figure is not None
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
