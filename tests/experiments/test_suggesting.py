import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rail_run import write_recipe
from toy_corrections import OFFSETS_M, shifted
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.checkpoint import save_tensors
from astra_data.core.errors import BadInputError
from astra_data.dataset import Dataset
from astra_data.experiments.experiment import load_experiment
from astra_data.experiments.suggesting import _usual, suggest
from astra_data.grounding.history import HistoryGrounding
from astra_data.reports import figures
from astra_data.worlds.registry import TASKS

FEW: dict[str, Any] = {"episodes": 3, "proposals": 20}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run with groundings of three seeds that add different numbers of meters."""
    experiment = load_experiment(write_recipe(tmp_path), tmp_path / "runs")
    for seed, offset in enumerate(OFFSETS_M):
        tensors, metadata = HistoryGrounding(shifted(offset)).to_file()
        made = experiment.folder / f"ground/nas/seed_{seed}"
        made.mkdir(parents=True)
        save_tensors(made / "grounding.safetensors", tensors, metadata | {"kind": HistoryGrounding.kind})
    (experiment.folder / "recipe.json").write_text(experiment.recipe.model_dump_json())
    return experiment.folder


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_the_way_from_a_run_to_its_next_episodes(folder: Path, tmp_path: Path) -> None:
    shown = CliRunner().invoke(app, ["suggest", str(folder), "--episodes", "3", "--proposals", "20"])
    assert shown.exit_code == 0, shown.output
    assert "suggested: 3 of 20 episodes" in shown.output
    assert sorted(contents(folder / "suggest")) == [
        *("config.json", "manifest.json", "map.json", "map.png", "plan.json", "suggest.md")
    ]
    config = json.loads((folder / "suggest/config.json").read_text())
    assert config["groundings"] == [f"ground/nas/seed_{seed}" for seed in range(3)]
    # As the recipe collects.
    assert (config["suggest"]["max_steps"], config["suggest"]["hold_s"]) == (40, [0.1, 0.4])
    with Image.open(folder / "suggest/map.png") as picture:
        assert picture.size[0] > 1000
    task = json.loads((folder / "recipe.json").read_text())["task"]
    plan, out = str(folder / "suggest/plan.json"), str(tmp_path / "more")
    assert f"astra-data collect {task} --plan {plan}" in shown.output
    printed = shown.output.partition("record them: ")[2].splitlines()[0]
    page = (folder / "suggest/suggest.md").read_text()
    assert printed in page.replace("FOLDER", str(folder / "suggest")).splitlines()
    shown = CliRunner().invoke(app, ["collect", task, "--plan", plan, "--out", out])
    assert shown.exit_code == 0, shown.output
    assert len(Dataset.open(out)) == 3 and Dataset.open(out).lengths.max() <= 40


def test_the_same_seed_gives_the_same_bytes_and_replaces_what_was_there(folder: Path, tmp_path: Path) -> None:
    for out, seed in ((None, 1), (tmp_path / "again", 1), (None, 2)):
        place, _, _ = suggest(folder, seed=seed, out=out, **FEW)
        assert place == (out or folder / "suggest")
        if seed == 1 and out is None:
            first = contents(place)
    assert contents(tmp_path / "again") == first
    assert contents(folder / "suggest")["plan.json"] != first["plan.json"]
    with pytest.raises(BadInputError, match="again is already finished"):
        suggest(folder, seed=1, out=tmp_path / "again", **FEW)


def test_a_row_of_a_recipe_is_asked_at_its_largest_size(folder: Path, tmp_path: Path) -> None:
    recipe = json.loads((folder / "recipe.json").read_text())
    more = {"methods": ["nas", "astra_plus"], "sweep": {"percent": [50, 100]}}
    (folder / "recipe.json").write_text(json.dumps(recipe | more))
    for size in ("050", "100"):
        shutil.copytree(folder / "ground/nas", folder / f"ground/astra/percent_{size}")
    place, _, _ = suggest(
        tmp_path / "rail.toml", row="astra_plus", root=tmp_path / "runs", max_steps=9, **FEW
    )
    config = json.loads((place / "config.json").read_text())
    assert place == folder / "suggest" and config["row"] == "astra"
    assert config["groundings"] == [f"ground/astra/percent_100/seed_{seed}" for seed in range(3)]
    assert config["suggest"]["max_steps"] == 9  # not as the recipe collects


def test_from_logs_alone_it_says_what_to_do_on_the_robot(folder: Path) -> None:
    recipe = json.loads((folder / "recipe.json").read_text())
    alone = {"task": recipe["task"].replace(":TASK", ":LOGS_ALONE"), "data": "logs", "collect": None}
    (folder / "recipe.json").write_text(json.dumps(recipe | alone))
    shown = CliRunner().invoke(app, ["suggest", str(folder), "--episodes", "2", "--proposals", "9"])
    assert shown.exit_code == 0 and "record them" not in shown.output
    page = (folder / "suggest/suggest.md").read_text()
    assert "bring it to each start" in page and "| episode | from | for | v |" in page
    config = json.loads((folder / "suggest/config.json").read_text())["suggest"]
    assert (config["max_steps"], config["start"]) == (40, "task")


def test_a_path_is_drawn_as_far_as_its_episode_goes(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []
    draw = figures.information_map

    def noted(maps: Any, starts: Any, paths: Any, maze: Any) -> Any:  # noqa: ANN401 - passed on
        drawn.append(paths)
        return draw(maps, starts, paths, maze)

    monkeypatch.setattr(figures, "information_map", noted)
    _, found, _ = suggest(folder, **FEW)
    there = found.rollouts.reached[:, found.taken].T.numpy() > 0
    np.testing.assert_array_equal(np.isfinite(drawn[0][..., 0]), there)


def test_what_cannot_disagree_is_refused_and_nothing_is_written(folder: Path) -> None:
    recipe = json.loads((folder / "recipe.json").read_text())
    (folder / "recipe.json").write_text(json.dumps(recipe | {"seeds": [1]}))
    shown = CliRunner().invoke(app, ["suggest", str(folder)])
    assert isinstance(shown.exception, BadInputError) and not (folder / "suggest").exists()
    assert "ground/nas: expected corrections that can disagree, got a single one" in str(shown.exception)
    (folder / "recipe.json").write_text(json.dumps(recipe | {"seeds": [7]}))
    with pytest.raises(
        BadInputError, match=r"expected groundings, .*seed_7 .*: run the recipe until ground first"
    ):
        suggest(folder)
    (folder / "recipe.json").write_text(json.dumps(recipe | {"methods": ["astra", "nas"], "seeds": [7]}))
    with pytest.raises(BadInputError, match="ground/nas/seed_7"):  # the reference goes before others
        suggest(folder)
    (folder / "recipe.json").write_text(json.dumps(recipe | {"methods": ["direct_transfer"]}))
    with pytest.raises(BadInputError, match="expected a row that grounds its simulator"):
        suggest(folder)
    assert not list(folder.glob(".suggest*"))


def test_without_a_collection_starts_are_anywhere_in_a_maze() -> None:
    for name, start in (("antmaze-umaze", "anywhere"), ("humanoid-walker2d", "task")):
        task = TASKS[name]
        assert _usual(task, {}) == {"max_steps": task.objective.horizon, "start": start}
