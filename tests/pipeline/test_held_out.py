from pathlib import Path
from typing import Any

import pytest

from astra_data.core.errors import RecipeError
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.held_out import write_errors
from astra_data.pipeline.points import Selection

CART = Path(__file__).parents[1] / "small_cart.py"


def written(folder: Path, text: str) -> Path:
    path = folder / "r.toml"
    path.write_text(f'task = "{CART}:LOGS_ALONE"\nseeds = [0]\n{text}')
    return path


def test_without_groundings_there_is_no_page(tmp_path: Path) -> None:
    path = written(tmp_path, 'data = "logs"\nmethods = ["direct_transfer", "nas"]\n')
    experiment = load_experiment(path, tmp_path / "runs")
    assert write_errors(experiment, Selection.of(experiment.recipe)) is None


def test_what_needs_a_target_is_refused_in_one_line(tmp_path: Path) -> None:
    path = written(tmp_path, 'methods = ["nas", "target", "full_obs"]\n')
    with pytest.raises(RecipeError) as caught:
        load_experiment(path, tmp_path / "runs")
    needing = 'methods: target, methods: full_obs, [collect] (give `data = "…"` in its place)'
    assert str(caught.value).endswith(f"has no target, which these need: {needing}")
    assert "\n" not in str(caught.value)


def test_rows_that_share_a_grounding_are_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = '"direct_transfer", "astra_plus", "nas", "nas_plus"'
    path, given = written(tmp_path, f'data = "logs"\nmethods = [{rows}]\n'), list[Any]()
    monkeypatch.setattr(
        "astra_data.pipeline.held_out.write_held_out", lambda *of, **more: given.append(of[2])
    )
    experiment = load_experiment(path, tmp_path / "runs")
    write_errors(experiment, Selection.of(experiment.recipe))
    write_errors(experiment, Selection.of(experiment.recipe, ("astra_plus",)))
    assert given == [("astra", "nas")] * 2  # NAS is the reference of a part, too


def test_the_page_is_of_what_was_selected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, given = written(tmp_path, 'data = "logs"\nmethods = ["nas"]\n'), list[Any]()
    path.write_text(path.read_text().replace("[0]", "[0, 1]") + "[sweep]\npercent = [50, 100]\n")
    monkeypatch.setattr(
        "astra_data.pipeline.held_out.write_held_out", lambda *of, **more: given.append((*of[3:], more))
    )
    experiment = load_experiment(path, tmp_path / "runs")
    write_errors(experiment, Selection.of(experiment.recipe, seeds=[1], percents=[50]))
    assert given == [((1,), (50,), {"timestep_s": 0.1})]
