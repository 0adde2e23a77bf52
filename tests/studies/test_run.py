import json
import shutil
from functools import partial
from pathlib import Path

import pytest
import torch
from toy_walks import write_archive
from typer.testing import CliRunner

from astra_data.cli import app as cli
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.studies.run import measure_gap

HOUSE = Path(__file__).parents[2]
RECIPE = """
mapping = "nao_guda.toml"
models = ["ridge", "astra"]
seeds = [0, 1]
minutes = [0.1]
horizons_s = [0.5, 1]
[walking]
piece_s = 10
[steps]
history = 4
[fit]
updates = 3
latent_size = 4
head_sizes = [4]
"""


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    shutil.copy(HOUSE / "recipes/imports/nao_guda.toml", tmp_path)
    path = tmp_path / "toy.toml"
    path.write_text(RECIPE)
    (tmp_path / "logs").mkdir()
    write_archive(tmp_path / "logs/a.tar.gz", 1250, seed=0)
    write_archive(tmp_path / "logs/b.tar.gz", 1250, seed=1)
    write_archive(tmp_path / "c.tar.gz", 700, seed=2)
    return path


def test_one_folder_is_split_and_each_recording_predicted_from_the_other(
    recipe: Path, tmp_path: Path
) -> None:
    root = tmp_path / "runs"
    page = measure_gap(recipe, tmp_path / "logs", root=root, publish=True)
    assert page == root / "toy/logs/results.md"
    found = json.loads(page.with_suffix(".json").read_text())
    held_out, *crossed = found["cases"]
    assert [case["name"] for case in crossed] == ["tested_on_a", "tested_on_b"]
    whole = sum(recording["minutes"] for recording in found["recordings"]) - held_out["test_minutes"]
    assert [size["minutes"] for size in held_out["sizes"]] == pytest.approx([0.1, whole])
    assert held_out["horizons_s"] == pytest.approx([1 / 6, 0.5, 1.0])
    ridge = held_out["sizes"][-1]["models"]["ridge"]["1"]
    assert ridge["mean"]["less_than_raw"] > 0.5
    text = page.read_text()
    assert "real robot, and this is prediction, not control" in text
    assert "self-localization, not motion capture" in text
    assert "--data" in text
    assert (tmp_path / "results/toy.png").read_bytes() == page.with_suffix(".png").read_bytes()
    fits = sorted(path for path in page.parent.rglob("*.safetensors"))
    times = [path.stat().st_mtime_ns for path in fits]
    fits[0].unlink()
    measure_gap(recipe, tmp_path / "logs", root=root)
    again = [path.stat().st_mtime_ns for path in fits]
    assert again[1:] == times[1:]
    assert again[0] > times[0]
    cases = json.loads(page.with_suffix(".json").read_text())["cases"]
    assert [case["sizes"] for case in cases] == [case["sizes"] for case in found["cases"]]


def test_another_recording_is_predicted_from_the_given_ones(
    recipe: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    request.addfinalizer(partial(torch.set_num_threads, torch.get_num_threads()))
    torch.set_num_threads(2)
    page = measure_gap(recipe, tmp_path / "c.tar.gz", tmp_path / "logs", seeds=[1], root=tmp_path / "runs")
    assert torch.get_num_threads() == 2
    assert page.parent.name == "c_from_logs"
    (case,) = json.loads(page.with_suffix(".json").read_text())["cases"]
    assert case["title"] == "Learned from a and b, tested on c"
    assert case["sizes"][-1]["minutes"] == pytest.approx(2 * 1249 / 3600)


def test_what_does_not_fit_is_refused(recipe: Path, tmp_path: Path) -> None:
    logs, root = tmp_path / "logs", tmp_path / "runs"
    with pytest.raises(BadInputError, match="hold the same recordings"):
        measure_gap(recipe, logs / "a.tar.gz", logs, root=root)
    with pytest.raises(BadInputError, match="no seed 7"):
        measure_gap(recipe, logs, seeds=[7], root=root)
    measure_gap(recipe, logs / "a.tar.gz", logs / "b.tar.gz", seeds=[0], root=root)
    recipe.write_text(RECIPE.replace("history = 4", "history = 5"))
    with pytest.raises(BadInputError, match="other settings or other recordings"):
        measure_gap(recipe, logs / "a.tar.gz", logs / "b.tar.gz", root=root)
    recipe.write_text(RECIPE.replace('"ridge"', '"rigde"'))
    with pytest.raises(RecipeError, match="did you mean 'ridge'"):
        measure_gap(recipe, logs, root=root)


def test_a_gap_recipe_is_checked(recipe: Path) -> None:
    def call() -> tuple[int, str]:
        result = CliRunner().invoke(cli.app, ["check", str(recipe)])
        return result.exit_code, f"{result.output}{result.exception or ''}"

    assert call() == (0, f"{recipe}: no errors; a recipe for `astra-data gap`\n")
    recipe.write_text(recipe.read_text().replace("updates", "update"))
    assert call()[0] == 1 and "fit.update: unknown key: did you mean 'updates'?" in call()[1]
    recipe.write_text(RECIPE.replace("nao_guda.toml", "nowhere.toml"))
    assert call()[0] == 1 and "expected a file of `astra-data import`" in call()[1]


def test_a_recipe_for_run_is_told_from_others(tmp_path: Path) -> None:
    path = tmp_path / "walks.toml"
    path.write_text('task = "antmaze-umaze"\nmethods = ["nas"]\nseeds = [0]\n')
    with pytest.raises(
        RecipeError, match="expected a recipe for `astra-data gap`, got one for `astra-data run`"
    ):
        measure_gap(path, tmp_path)


def test_seeds_of_a_recipe_are_listed(recipe: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"the recipe has no seed 9; its seeds: \d"):
        measure_gap(recipe, tmp_path / "logs", seeds=[9], root=tmp_path / "runs")
