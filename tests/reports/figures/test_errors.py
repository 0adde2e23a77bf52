from pathlib import Path

import numpy as np
from fake_runs import line, results
from figures_shown import legend

from astra_data.reports.figures.charts import open_loop_error, predictive_validity, reliability
from astra_data.reports.figures.style import Scene, method_color, png
from astra_data.reports.results import TESTED, Errors, Results
from astra_data.robots.registry import TASKS

SCENE = Scene(Path(), TASKS["antmaze-umaze"])


def with_errors(raw: dict[str, float], *quantities: str) -> Results:
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
    return results(rows=("nas", "astra", "iql"), errors=errors)


def test_open_loop_error_is_logarithmic_and_draws_a_shared_raw_simulator_once() -> None:
    figure = open_loop_error(with_errors({"nas": 1.0, "astra": 1.0}, "position_m"), SCENE)
    assert figure is not None
    (axes,) = figure.axes
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert axes.get_ylabel() == "position error (m)" and legend(figure) == ["no grounding", "NAS", "ASTRA"]
    assert np.asarray(axes.lines[0].get_xydata()).tolist() == [[1.0, 1.0], [10.0, 2.0]]
    assert len(axes.collections) == 3 and open_loop_error(with_errors({}), SCENE) is None
    of_smaller = [one.model_copy(update={"percent": 50}) for one in with_errors({"nas": 1.0}, "position_m").errors]
    assert open_loop_error(results(errors=of_smaller, lines=[line("iql", 0, TESTED, success=0.5)]), SCENE) is None


def test_raw_simulators_that_differ_are_all_drawn_and_units_follow_from_the_names() -> None:
    names = ("turn_rate_rad_s", "speed_m_s", "push_m_s2", "heading_rad", "tilt_deg", "energy")
    figure = open_loop_error(with_errors({"nas": 1.0, "astra": 1.005, "iql": 1.03}, *names), SCENE)
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


def test_observed_rates_stand_over_predicted_ones_above_their_numbers_of_steps() -> None:
    nas = np.array([[0.01, 0.2, 0.6], [0.0, 0.1, 0.5], [9000.0, 60.0, 20.0]])
    astra = np.array([[0.3], [0.4], [10.0]])
    figure = reliability({"failure model": {"nas": nas, "astra_plus": astra}, "topple head": {"nas": nas}})
    model, head, model_steps, head_steps = figure.axes
    assert [axes.get_title(loc="left") for axes in (model, head)] == ["failure model", "topple head"]
    equal, first, second = model.lines
    assert equal.get_linestyle() == "--"
    assert [np.asarray(axis).tolist() for axis in equal.get_data()] == [[0, 1], [0, 1]]
    assert [np.asarray(axis).tolist() for axis in first.get_data()] == nas[:2].tolist()
    assert [line.get_color() for line in (first, second)] == [method_color("nas"), method_color("astra_plus")]
    assert (first.get_linestyle(), second.get_linestyle()) == ("-", "--")
    counts, _ = model_steps.lines
    assert [np.asarray(axis).tolist() for axis in counts.get_data()] == nas[[0, 2]].tolist()
    assert model_steps.get_yscale() == "log" and len(head.lines) == 2 and len(head_steps.lines) == 1
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["NAS", "ASTRA+"]
    # A quarter stands half-way: rates are drawn by their square roots.
    left, middle, right = (model.transData.transform((rate, rate)) for rate in (0.0, 0.25, 1.0))
    np.testing.assert_allclose(middle, (left + right) / 2)
    assert png(figure).startswith(b"\x89PNG")


def test_validity_draws_a_dot_per_policy_in_its_methods_color() -> None:
    returns = [
        *(("nas", 0, TESTED, 3.0), ("nas", 1, TESTED, 4.0), ("astra_plus", 0, TESTED, 6.0)),
        *(("nas", 0, "raw", 1.0), ("nas", 1, "raw", 2.0), ("astra_plus", 0, "raw", 5.0)),
        ("nas", 0, "grounded", 7.0),
    ]
    found = results(*(line(row, seed, where, 100, **{"return": one}) for row, seed, where, one in returns))
    figure = predictive_validity(found, SCENE)
    assert figure is not None
    raw, grounded = figure.axes
    titles = [axes.get_title(loc="left") for axes in (raw, grounded)]
    assert titles == ["Raw simulator", "Grounded simulator"] and legend(figure) == ["NAS", "ASTRA+"]
    equal, nas, astra = raw.lines
    assert equal.get_linestyle() == "--"
    assert [np.asarray(axis).tolist() for axis in nas.get_data()] == [[1.0, 2.0], [3.0, 4.0]]
    assert [line.get_color() for line in (nas, astra)] == [method_color("nas"), method_color("astra_plus")]
    assert nas.get_marker() != astra.get_marker() and len(grounded.lines) == 2
    assert png(figure).startswith(b"\x89PNG")
    assert predictive_validity(found.model_copy(update={"tested_in": "simulators"}), SCENE) is None
