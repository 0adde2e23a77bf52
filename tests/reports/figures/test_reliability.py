import numpy as np

from astra_data.reports.figures.reliability import reliability
from astra_data.reports.figures.style import method_color, png


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
    assert [line.get_color() for line in (first, second)] == [
        method_color("nas"),
        method_color("astra_plus"),
    ]
    assert (first.get_linestyle(), second.get_linestyle()) == ("-", "--")
    counts, _ = model_steps.lines
    assert [np.asarray(axis).tolist() for axis in counts.get_data()] == nas[[0, 2]].tolist()
    assert model_steps.get_yscale() == "log" and len(head.lines) == 2 and len(head_steps.lines) == 1
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["NAS", "ASTRA+"]
    # A quarter stands half-way: rates are drawn by their square roots.
    left, middle, right = (model.transData.transform((rate, rate)) for rate in (0.0, 0.25, 1.0))
    np.testing.assert_allclose(middle, (left + right) / 2)
    assert png(figure).startswith(b"\x89PNG")
