import re

from matplotlib.colors import to_hex

from astra_data.methods import METHODS
from astra_data.reports.figures.walks import walk_prediction
from astra_data.studies.models import MODELS


def test_models_that_are_methods_look_as_methods_do() -> None:
    assert list(MODELS) == ["raw", "gains", "ridge", "mlp", "nas", "astra"]
    for name in ("nas", "astra"):
        assert (MODELS[name].title, MODELS[name].color) == (METHODS[name].title, METHODS[name].color)
    assert MODELS["mlp"].title == "Feed-forward network"
    assert all(re.fullmatch(r"#[0-9A-F]{6}", model.color) for model in MODELS.values())
    for values in ([model.title for model in MODELS.values()], [model.color for model in MODELS.values()]):
        assert len(set(values)) == len(MODELS)


def test_a_figure_shows_titles_and_colors() -> None:
    looks = {name: (model.title, model.color) for name, model in MODELS.items()}
    bands = {"forward_m": {name: [[1.0, 2.0]] * 3 for name in ("raw", "astra")}}
    figure = walk_prediction([0.5, 1.0], bands, [3.0], {}, 1.0, looks)  # type: ignore[arg-type]
    lines = figure.axes[0].get_lines()
    assert [line.get_label() for line in lines] == ["Raw simulator", "ASTRA"]
    assert [to_hex(line.get_color()).upper() for line in lines] == ["#2B2B2B", "#009E73"]
    assert [line.get_linestyle() for line in lines] == [":", "-"]
