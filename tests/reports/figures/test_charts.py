from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_dataset import write_fake
from fake_runs import line, results
from figures_shown import drawn, legend

from astra_data.reports.figures.charts import data_efficiency, learning_curves, on_one_grid, score_bars
from astra_data.reports.figures.style import Scene
from astra_data.reports.results import SIMULATED, TrainingFacts
from astra_data.robots.registry import TASKS
from astra_data.worlds.objective import RETURN, SUCCESS, SURVIVED_STEPS


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path, TASKS["antmaze-umaze"])


def test_bars_show_mean_interval_seeds_and_the_own_simulator(scene: Scene) -> None:
    found = results(
        *(line("direct_transfer", seed, success=0.0) for seed in range(3)),
        *(line("astra_plus", seed, success=share) for seed, share in enumerate((0.0, 0.03, 0.06))),
        *(line("astra_plus", seed, SIMULATED, success=1.0) for seed in range(3)),
    )
    figure = drawn(score_bars(found, scene, measure="success"))
    (axes,) = figure.axes
    # The number of a bar stands beside its name: a diamond at 1.00 is not taken for what it says.
    labels = [text.get_text() for text in axes.get_yticklabels()]
    assert labels == ["Direct transfer (floor)   0.00", "ASTRA+   0.03"] and not axes.texts
    assert [patch.get_width() for patch in axes.patches] == pytest.approx([0.0, 0.03])  # type: ignore[attr-defined]
    summary = found.score_of("astra_plus")
    assert summary is not None
    lines = [np.asarray(of.get_xdata()) for of in axes.lines if len(np.asarray(of.get_xdata())) == 2]
    assert lines[1].tolist() == [summary.low, summary.high]
    (diamond,) = [of for of in axes.lines if of.get_marker() == "D"]
    assert np.asarray(diamond.get_xydata()).tolist() == [[1.0, 1.0]]
    assert axes.get_xlim() == (0.0, 1.0) and axes.get_xlabel() == "success rate in the target"
    assert "in its own simulator" in legend(figure) and score_bars(found, scene, measure="return") is None


def test_seeds_without_interval_and_scores_without_limit(scene: Scene) -> None:
    values: dict[str, Any] = {"steps": 300.0, "return": 1.0}
    found = results(line("nas", 0, **values), scores=(SURVIVED_STEPS, RETURN))
    figure = drawn(score_bars(found, scene, measure="steps"))
    assert not [of for of in figure.axes[0].lines if len(np.asarray(of.get_xdata())) == 2]
    assert figure.axes[0].get_xlim()[1] > 300 and "in its own simulator" not in legend(figure)
    assert drawn(score_bars(found, scene, measure="return")).axes[0].get_yticklabels()[0].get_text() == "NAS   1.0"


def training(row: str, seed: int, *scores: float) -> TrainingFacts:
    return TrainingFacts(row=row, seed=seed, steps=[1000.0 * k for k in range(len(scores))], score=[*scores])


def test_curves_have_a_panel_per_method_and_a_band_from_worst_to_best(scene: Scene) -> None:
    trainings = [
        training("astra", 0, 0.0, 0.5, 1.0),
        training("astra", 1, 0.2, 0.3, 0.4),
        training("astra_plus", 0, 0.1, 0.1, 0.1),
        training("nas", 0, float("nan"), float("nan"), float("nan")),
    ]
    found = results(line("astra", 0, success=1.0), trainings=trainings, rows=("nas", "astra", "astra_plus"))
    figure = drawn(learning_curves(found, scene))
    axes = next(axes for axes in figure.axes if axes.get_title(loc="left"))
    assert axes.get_title(loc="left") == "ASTRA" and [of.get_linestyle() for of in axes.lines] == ["-", "--"]
    assert np.asarray(axes.lines[0].get_ydata())[[0, -1]] == pytest.approx([0.1, 0.7])
    band = np.asarray(axes.collections[0].get_paths()[0].vertices)[:, 1]
    assert (band.min(), band.max()) == pytest.approx((0.0, 1.0))
    assert figure.get_supylabel() == f"{SUCCESS.title} of training\nepisodes, from all starts"
    assert "with the plus settings" in legend(figure)
    assert learning_curves(results(line("astra", 0, success=1.0)), scene) is None


def test_curves_are_compared_where_all_seeds_have_scores() -> None:
    nan = float("nan")
    steps, scores = on_one_grid(
        [(np.array([0.0, 10.0, 20.0]), np.array([nan, 1.0, 2.0])), (np.array([5.0, 15.0]), np.array([0.0, 1.0]))]
    )
    assert (steps[0], steps[-1]) == (10.0, 15.0)
    np.testing.assert_allclose(scores[:, [0, -1]], [[1.0, 1.5], [0.5, 1.0]])


def test_data_efficiency_has_a_map_per_size_and_a_band_per_method(scene: Scene) -> None:
    found = results(
        *(line("nas", seed, percent=25, success=share) for seed, share in enumerate((0.1, 0.2, 0.3))),
        *(line("nas", seed, percent=100, success=share) for seed, share in enumerate((0.7, 0.8, 0.9))),
        line("astra", 0, percent=100, success=0.5),
    )
    for percent in (25, 100):
        write_fake(scene.root / f"subset/percent_{percent:03d}/seed_0")
    *maps, success = drawn(data_efficiency(found, scene)).axes
    assert [axes.get_title() for axes in maps[:2]] == ["25 %", "100 %"]
    assert np.asarray(success.lines[0].get_xydata()) == pytest.approx(np.array([[25, 0.2], [100, 0.8]]))
    band, none = success.collections  # a seed alone has no interval, so ASTRA's band is empty
    assert not none.get_paths()
    at = {size: found.score_of("nas", percent=size) for size in (25, 100)}
    ends = {(x, y) for x, y in np.asarray(band.get_paths()[0].vertices).tolist()}
    assert ends == {(size, end) for size, one in at.items() if one for end in (one.low, one.high)}
    assert success.get_ylim() == (-0.02, 1.02) and success.get_ylabel() == "success rate in the target"
    assert data_efficiency(results(line("nas", 0, success=1.0)), scene) is None
