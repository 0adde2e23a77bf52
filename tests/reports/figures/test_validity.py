from pathlib import Path

import numpy as np
from figures_shown import legend

from astra_data.reports.figures.scene import Scene
from astra_data.reports.figures.style import method_color, png
from astra_data.reports.figures.validity import predictive_validity
from astra_data.reports.results import TESTED, Line, Results
from astra_data.robots.registry import TASKS

SCENE = Scene(Path(), TASKS["antmaze-umaze"])


def test_validity_draws_a_dot_per_policy_in_its_methods_color() -> None:
    returns = [
        *(("nas", 0, TESTED, 3.0), ("nas", 1, TESTED, 4.0), ("astra_plus", 0, TESTED, 6.0)),
        *(("nas", 0, "raw", 1.0), ("nas", 1, "raw", 2.0), ("astra_plus", 0, "raw", 5.0)),
        ("nas", 0, "grounded", 7.0),
    ]
    lines = [
        Line(row=row, seed=seed, where=where, values={"return": one}) for row, seed, where, one in returns
    ]
    found = Results(recipe="r", task="t", command="", rows=("nas", "astra_plus"), episodes=1, lines=lines)
    figure = predictive_validity(found, SCENE)
    assert figure is not None
    raw, grounded = figure.axes
    titles = [axes.get_title(loc="left") for axes in (raw, grounded)]
    assert titles == ["Raw simulator", "Grounded simulator"]
    assert legend(figure) == ["NAS", "ASTRA+"]
    equal, nas, astra = raw.lines
    assert equal.get_linestyle() == "--"
    assert [np.asarray(axis).tolist() for axis in nas.get_data()] == [[1.0, 2.0], [3.0, 4.0]]
    assert [line.get_color() for line in (nas, astra)] == [method_color("nas"), method_color("astra_plus")]
    assert nas.get_marker() != astra.get_marker()
    assert len(grounded.lines) == 2
    assert png(figure).startswith(b"\x89PNG")
    nowhere = found.model_copy(update={"tested_in": "simulators"})
    assert predictive_validity(nowhere, SCENE) is None
