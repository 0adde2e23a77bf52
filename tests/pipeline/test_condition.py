"""The condition of artifacts that fake stages made, with real manifests."""

import json
import re
import shutil
from collections.abc import Iterable
from pathlib import Path
from unittest.mock import Mock

import pytest
from typer.testing import CliRunner

from astra_data.cli import app as cli
from astra_data.core.artifact import MANIFEST, read_manifest
from astra_data.core.errors import AstraDataError, BadInputError, MissingStageError
from astra_data.core.progress import silent
from astra_data.pipeline.condition import LOADERS, condition
from astra_data.pipeline.executors import Item
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.plan import plan
from astra_data.pipeline.run import check, run, run_stage
from astra_data.pipeline.stages.registry import STAGES

pytestmark = pytest.mark.usefixtures("fake_recipe")
COLLECT = "collect/seed_0"
GROUND, TRAIN, ALIGN, EVALUATE = (
    f"{stage}/astra/seed_0" for stage in ("ground", "train", "align", "evaluate")
)
PLUS = ("train/astra_plus/seed_0", "evaluate/astra_plus/seed_0")


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    def execute(items: Iterable[Item], **_: object) -> None:
        for item in items:
            item.call(progress=silent)

    monkeypatch.setattr("astra_data.pipeline.run.execute", execute)


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "r.toml"
    path.write_text('task = "maze"\nmethods = ["astra", "astra_plus"]\nseeds = [0]\n')
    return path


@pytest.fixture
def folder(recipe: Path, tmp_path: Path) -> Path:
    return run(recipe, root=tmp_path, jobs=1)


def states(recipe: Path, *, verify: bool = False) -> dict[str, tuple[str, str]]:
    found = check(recipe, root=recipe.parent, verify=verify)
    return {key: (of.state, of.why) for key, of in found.items() if (of.state, of.why) != ("finished", "")}


def made_again(folder: Path) -> list[str]:
    aside = folder / "set_aside"
    return sorted(path.relative_to(aside).as_posix() for path in aside.rglob("seed_0"))


def test_a_manifest_is_read_once(recipe: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    experiment = load_experiment(recipe, recipe.parent)
    (item,) = (one for one in plan(experiment.recipe, recipe, folder) if one.key == EVALUATE)
    read = Mock(wraps=read_manifest)
    monkeypatch.setattr("astra_data.pipeline.condition.read_manifest", read)
    assert condition(item, experiment).is_finished
    read_folders = [call.args[0] for call in read.call_args_list]
    assert read_folders.count(folder / EVALUATE) == 1


def test_an_emptied_file_is_found_and_made_again(
    recipe: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = folder / TRAIN / "policy.safetensors"
    whole = policy.read_bytes()
    policy.write_bytes(b"")
    why = f"policy.safetensors has 0 bytes, expected {len(whole)}"
    assert states(recipe) == {TRAIN: ("damaged", why)}
    capsys.readouterr()
    run(recipe, root=recipe.parent, jobs=1)
    assert policy.read_bytes() == whole
    assert states(recipe) == {}
    lines = capsys.readouterr().out.splitlines()[:2]
    aside = folder / "set_aside/1"
    assert lines == [
        f"{TRAIN} is recreated: damaged ({why}); the old one is in {aside / TRAIN}",
        f"{EVALUATE} is recreated: made from {TRAIN}; the old one is in {aside / EVALUATE}",
    ]
    assert (aside / TRAIN / "policy.safetensors").read_bytes() == b""
    assert made_again(folder) == [f"1/{EVALUATE}", f"1/{TRAIN}"]
    assert not (aside / "report").exists(), "every run makes it"


def test_each_artifact_is_made_again_for_its_own_damage_first(
    recipe: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for key in (GROUND, ALIGN):
        for file in ("asked.json", "metrics.json"):
            (folder / key / file).unlink()
    capsys.readouterr()
    run(recipe, root=recipe.parent, jobs=1)
    told = dict(re.findall(r"(\S+) is recreated: (.*);", capsys.readouterr().out))
    assert told[GROUND] == told[ALIGN] == "damaged (asked.json is missing; metrics.json is missing)"
    assert told[TRAIN] == f"made from {GROUND}"


def test_damage_of_a_policy_is_none_of_its_grounding(recipe: Path, folder: Path) -> None:
    policy = folder / TRAIN / "policy.safetensors"
    policy.write_bytes(b"x" + policy.read_bytes()[1:])
    shutil.rmtree(folder / EVALUATE)
    run(recipe, root=recipe.parent, jobs=1)
    assert made_again(folder) == [f"1/{TRAIN}"]


def test_what_a_stage_reads_but_does_not_make_stays_where_it_is(recipe: Path, folder: Path) -> None:
    altered = folder / "pair/seed_0/altered"
    altered.touch()
    shutil.rmtree(folder / "ground")
    run_stage(recipe, "ground", root=recipe.parent, jobs=1)
    assert altered.exists() and not (folder / "set_aside").exists()


def test_what_is_set_aside_twice_is_there_twice(recipe: Path, folder: Path) -> None:
    for _ in range(2):
        (folder / EVALUATE / "evaluation.json").unlink()
        run(recipe, root=recipe.parent, jobs=1)
    assert made_again(folder) == [f"1/{EVALUATE}", f"2/{EVALUATE}"]


def test_altered_bytes_are_found_where_a_step_reads_them(recipe: Path, folder: Path) -> None:
    grounding = folder / GROUND / "grounding.safetensors"
    whole = grounding.read_bytes()
    grounding.write_bytes(b"x" + whole[1:])
    assert states(recipe) == {}
    assert states(recipe, verify=True)[GROUND] == ("damaged", "grounding.safetensors was altered")
    run(recipe, root=recipe.parent, jobs=1)
    assert grounding.read_bytes() != whole, "no step reads the grounding"
    shutil.rmtree(folder / PLUS[1])
    run(recipe, root=recipe.parent, jobs=1)
    assert grounding.read_bytes() == whole
    assert made_again(folder) == sorted(f"1/{key}" for key in (GROUND, TRAIN, ALIGN, EVALUATE, PLUS[0]))


def test_what_only_its_bytes_give_away_is_to_be_removed(recipe: Path, folder: Path) -> None:
    weights = folder / PLUS[0] / "policy.safetensors"
    whole = weights.read_bytes()
    weights.write_bytes(b"x" + whole[1:])
    asked = ["check", str(recipe), "--verify", "--root", str(recipe.parent)]
    told = CliRunner().invoke(cli.app, asked).exception
    assert str(told).endswith(f" damaged: move them away, and `astra-data run {recipe}` recreates these")
    shutil.rmtree(weights.parent)  # as it says
    run(recipe, root=recipe.parent, jobs=1)
    assert weights.read_bytes() == whole and states(recipe) == {}


def test_altered_values_of_a_dataset_are_made_again_once_a_step_reads_them(
    recipe: Path, folder: Path
) -> None:
    altered = folder / COLLECT / "altered"
    altered.touch()
    assert states(recipe, verify=True)[COLLECT] == ("damaged", "a value was altered")
    run(recipe, root=recipe.parent, jobs=1)
    assert altered.exists(), "no step reads the episodes"
    shutil.rmtree(folder / "pair/seed_0")
    run(recipe, root=recipe.parent, jobs=1)
    assert not altered.exists()
    assert (folder / "set_aside/1" / COLLECT / "altered").exists()
    assert states(recipe) == {}


def test_a_damaged_input_of_one_stage_is_refused_with_what_to_run(recipe: Path, folder: Path) -> None:
    grounding = folder / GROUND / "grounding.safetensors"
    grounding.write_bytes(b"x" + grounding.read_bytes()[1:])
    shutil.rmtree(folder / TRAIN)
    with pytest.raises(MissingStageError) as caught:
        run_stage(recipe, "train", root=recipe.parent)
    assert str(caught.value) == (
        f"{folder / GROUND} is damaged (grounding.safetensors was altered): "
        f"run `astra-data ground {recipe} --root {recipe.parent}` first"
    )


def test_an_artifact_of_another_input_is_stale(recipe: Path, folder: Path) -> None:
    shutil.rmtree(folder / "collect/seed_0")
    run(recipe, root=recipe.parent, jobs=1)
    assert states(recipe) == {}, "the same episodes again"
    description = folder / "collect/seed_0/dataset.json"
    description.write_text(json.dumps(json.loads(description.read_text()) | {"content_hash": "other"}))
    stale = ("stale", "made from another collect/seed_0")
    assert states(recipe) == {"pair/seed_0": stale}
    run(recipe, root=recipe.parent, jobs=1, until="pair")
    assert made_again(folder) == ["1/pair/seed_0"]
    assert json.loads((folder / "pair/seed_0/dataset.json").read_text())["parents"] == [{"hash": "other"}]


def test_a_file_that_somebody_added_is_a_remark(recipe: Path, folder: Path) -> None:
    (folder / TRAIN / "notes.txt").touch()
    assert states(recipe) == {TRAIN: ("finished", "not of it: notes.txt")}
    run(recipe, root=recipe.parent, jobs=1)
    assert (folder / TRAIN / "notes.txt").exists()


def test_a_missing_or_damaged_manifest_is_damage(recipe: Path, folder: Path) -> None:
    (folder / ALIGN / MANIFEST).unlink()
    assert states(recipe)[ALIGN] == ("damaged", "manifest.json is missing")
    (folder / TRAIN / MANIFEST).write_text("{")
    state, why = states(recipe)[TRAIN]
    assert state == "damaged" and why.startswith("manifest.json cannot be read")


def test_a_manifest_without_the_result_is_compared_with_nothing(recipe: Path, folder: Path) -> None:
    manifest = folder / TRAIN / MANIFEST
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"files": {}}))
    assert EVALUATE not in states(recipe)


def test_a_damaged_dataset_that_no_stage_made_is_not_replaced(recipe: Path, folder: Path) -> None:
    description = folder / "collect/seed_0/dataset.json"
    description.write_text("{")
    with pytest.raises(BadInputError, match=r"collect/seed_0 is damaged .* and was not made by this recipe"):
        run(recipe, root=recipe.parent)
    assert description.read_text() == "{"
    assert not (folder / "set_aside").exists()


def test_a_damaged_dataset_of_another_origin_is_not_replaced(recipe: Path, folder: Path) -> None:
    description = folder / COLLECT / "dataset.json"
    description.write_text(json.dumps(json.loads(description.read_text()) | {"stage": "import"}))
    (folder / COLLECT / "altered").touch()
    shutil.rmtree(folder / "pair")
    with pytest.raises(BadInputError, match=r"collect/seed_0 is damaged .* and was not made by this recipe"):
        run(recipe, root=recipe.parent)
    assert (folder / COLLECT / "altered").exists()


def test_the_command_lists_what_is_wrong_and_fails(recipe: Path, folder: Path) -> None:
    def call(*options: str) -> tuple[str, BaseException | None]:
        result = CliRunner().invoke(cli.app, ["check", str(recipe), "--root", str(recipe.parent), *options])
        return result.output, result.exception

    grounding = folder / GROUND / "grounding.safetensors"
    grounding.write_bytes(b"x" + grounding.read_bytes()[1:])
    output, error = call()
    assert "9 of 9 items are finished" in output and error is None
    shutil.rmtree(folder / PLUS[1])
    output, error = call("--verify")
    assert f"  damaged   {GROUND}: grounding.safetensors was altered\n" in output
    assert f"  to do     {PLUS[1]}\n" in output
    assert isinstance(error, AstraDataError)
    assert f"{recipe}: " in str(error) and "damaged" in str(error) and "astra-data run" in str(error)


def test_a_choice_is_made_again_once_there_are_more_policies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = tmp_path / "r.toml"
    rows = 'task = "maze"\nmethods = ["nas"]\nseeds = [0, 1]\n'
    recipe.write_text(rows + "[select]\n")
    folder = run(recipe, root=tmp_path, jobs=1)
    assert states(recipe, verify=False) == {}
    recipe.write_text(rows.replace("[0, 1]", "[0, 1, 2]") + "[select]\n")
    assert states(recipe)["select"] == ("stale", "made without train/nas/seed_2")
    capsys.readouterr()
    run(recipe, root=tmp_path, jobs=1)
    why = "select is recreated: stale (made without train/nas/seed_2)"
    assert why in capsys.readouterr().out and states(recipe) == {}
    # Of fewer policies it need not be made again.
    run(recipe, root=tmp_path, jobs=1, seeds=[0, 1])
    assert [path.name for path in (folder / "set_aside").iterdir()] == ["1"]
    shutil.rmtree(folder / "train/nas/seed_1")
    run(recipe, root=tmp_path, jobs=1, until="select")
    assert states(recipe) == {}


def test_a_choice_is_asked_for_by_its_table_which_changes_nothing_else(tmp_path: Path) -> None:
    recipe, record = tmp_path / "r.toml", tmp_path / "r/recipe.json"
    rows = 'task = "maze"\nmethods = ["nas"]\nseeds = [0, 1]\n'
    recipe.write_text(rows)
    folder = run(recipe, root=tmp_path, jobs=1)
    assert not (folder / "select").exists() and "select" not in json.loads(record.read_text())
    recipe.write_text(rows + "[select]\nsteps = 2\n")
    run(recipe, root=tmp_path, jobs=1)
    assert (folder / "select").is_dir() and not (folder / "set_aside").exists()
    recipe.write_text(rows + "[select]\nsteps = 3\n")
    with pytest.raises(
        AstraDataError, match=rf"select \(steps: 2, now 3\) changed in the recipe.* remove {folder}/select$"
    ):
        run(recipe, root=tmp_path, jobs=1)


def test_whole_files_that_no_stage_can_read_are_damage(recipe: Path, folder: Path) -> None:
    found = states(recipe, verify=True)
    for key in (GROUND, TRAIN, ALIGN):  # whose fakes are no networks
        assert found[key][0] == "damaged" and found[key][1].endswith(", after removing this")


def test_the_result_of_every_stage_is_read_as_others_read_it(tmp_path: Path) -> None:
    assert LOADERS.keys() == {stage.name for stage in STAGES.values() if stage.result}
    (tmp_path / "result").write_text("{}")
    for load in LOADERS.values():
        with pytest.raises(AstraDataError):
            load(tmp_path / "result")
