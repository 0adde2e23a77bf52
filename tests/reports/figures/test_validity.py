import numpy as np
from figures_shown import legend

from astra_data.reports.figures.style import method_color, png
from astra_data.reports.figures.validity import SimulatorReturns, predictive_validity


def test_validity_draws_a_dot_per_policy_in_its_rows_color() -> None:
    returns = {"nas": np.array([[1.0, 2.0], [3.0, 4.0]]), "astra_plus": np.array([[5.0], [6.0]])}
    figure = predictive_validity(
        [SimulatorReturns("Raw simulator", returns), SimulatorReturns("Grounded", {})]
    )
    raw, grounded = figure.axes
    assert (raw.get_title(loc="left"), grounded.get_title(loc="left")) == ("Raw simulator", "Grounded")
    assert legend(figure) == ["NAS", "ASTRA+"]
    equal, nas, astra = raw.lines
    assert equal.get_linestyle() == "--"
    assert [np.asarray(axis).tolist() for axis in nas.get_data()] == [[1.0, 2.0], [3.0, 4.0]]
    assert [line.get_color() for line in (nas, astra)] == [method_color("nas"), method_color("astra_plus")]
    assert nas.get_marker() != astra.get_marker()
    assert len(grounded.lines) == 1
    assert png(figure).startswith(b"\x89PNG")
