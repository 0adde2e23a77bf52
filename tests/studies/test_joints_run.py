"""`astra-data gap` on joint logs, from the files to the page."""

import json
import os
import shutil
from pathlib import Path

import pytest
from toy_joints import NAMES, write_log

from astra_data.core.errors import BadInputError
from astra_data.studies.run import measure_gap

HOUSE = Path(__file__).parents[2]
SHARED = Path(os.environ.get("ASTRA_DATA_LOGS", HOUSE.parent / "shared/data"))
MAPPING = """
name = "toy"
task = "t"
fps = 400
[columns."observation.state"]
fields = ["dof_pos"]
names = ["LF_HAA", "LF_HFE", "LF_KFE"]
"""
TARGETS = '[columns.action]\nfields = ["des_dof_pos"]\n'
RECIPE = """
mapping = "toy_mapping.toml"
simulator = "joints"
models = ["gains", "ridge", "astra"]
seeds = [0]
horizons_s = [0.1]
[joints]
piece_s = 1
[steps]
rows = 4
history = 4
[fit]
start = "ridge"
updates = 2
latent_size = 4
head_sizes = [4]
"""


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "toy.toml"
    path.write_text(RECIPE)
    (tmp_path / "toy_mapping.toml").write_text(MAPPING + TARGETS)
    (tmp_path / "logs").mkdir()
    for number in range(2):
        write_log(tmp_path / f"logs/run_{number}.pt", 1600, seed=number)
    return path


def test_each_log_is_a_recording_predicted_from_the_other(recipe: Path, tmp_path: Path) -> None:
    page = measure_gap(recipe, tmp_path / "logs", root=tmp_path / "runs")
    found = json.loads(page.with_suffix(".json").read_text())
    assert [case["name"] for case in found["cases"]] == [
        "held_out_pieces",
        "tested_on_run_0",
        "tested_on_run_1",
    ]
    crossed = found["cases"][1]
    assert crossed["axes"] == ["all_joints", *NAMES]
    errors = crossed["sizes"][-1]["models"]
    cells = errors["ridge"]["0.1"]
    mean = sum(cells[name]["rmse"] ** 2 for name in NAMES) / 3
    assert cells["all_joints"]["rmse"] == pytest.approx(mean**0.5, rel=1e-3)
    assert cells["mean"]["less_than_raw"] == cells["all_joints"]["less_than_raw"] > 0.9
    text = page.read_text()
    assert "| LF_KFE |" in text and "Second-order response" in text
    assert "have no targets" not in text and "walk" not in text
    assert page.with_suffix(".png").stat().st_size > 1000


def test_logs_without_targets_are_predicted_and_never_mixed_with_others(recipe: Path, tmp_path: Path) -> None:
    measure_gap(recipe, tmp_path / "logs/run_0.pt", root=tmp_path / "runs")
    with_targets = next((tmp_path / "runs/toy/recordings").iterdir())
    (tmp_path / "toy_mapping.toml").write_text(MAPPING)
    page = measure_gap(recipe, tmp_path / "logs/run_1.pt", root=tmp_path / "runs")
    assert "These recordings have no targets" in page.read_text()
    with pytest.raises(BadInputError, match="the same joints, with targets in all or in none"):
        measure_gap(recipe, tmp_path / "logs/run_1.pt", with_targets, root=tmp_path / "runs")


def test_the_legs_of_the_real_icub(tmp_path: Path) -> None:
    log = SHARED / "icub_walking/walking.mat"
    if not log.is_file():
        pytest.skip(f"no log of the iCub in {SHARED}; $ASTRA_DATA_LOGS names another folder")
    (tmp_path / "imports").mkdir()
    shutil.copy(HOUSE / "recipes/imports/icub_walking.toml", tmp_path / "imports")
    recipe = tmp_path / "icub.toml"
    recipe.write_text((HOUSE / "recipes/icub_joints.toml").read_text().replace('"mlp", "nas", "astra"', ""))
    page = measure_gap(recipe, log, root=tmp_path / "runs")
    found = json.loads(page.with_suffix(".json").read_text())
    (recording,) = found["recordings"]
    assert (recording["name"], recording["minutes"] * 60) == ("walking", pytest.approx(1187 / 99))
    errors = found["cases"][0]["sizes"][-1]["models"]
    raw, ridge = (errors[name]["0.202"]["all_joints"]["rmse"] for name in ("raw", "ridge"))
    assert 0.01 < ridge < 0.8 * raw
