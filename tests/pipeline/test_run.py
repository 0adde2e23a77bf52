"""Runs of fake stages: what is made, made again, refused and told."""

import csv
import json
import re
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from fake_runs import edit_json, line, results
from fake_stages import FakeStages

from astra_data.core.artifact import MANIFEST
from astra_data.core.errors import AstraDataError, BadInputError, MissingStageError, RecipeError
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.plan import selected
from astra_data.pipeline.run import check, check_device, make, run, run_stage
from astra_data.reports.results import results_json
from astra_data.worlds.task import Task

HEAD = 'task = "antmaze-umaze"\nmethods = ["astra", "astra_plus"]\nseeds = [0]\n'
GROUND, TRAIN, ALIGN, EVALUATE = (f"{stage}/astra/seed_0" for stage in ("ground", "train", "align", "evaluate"))
MADE_OF_DATA = ("astra", "astra_plus", "target")
PLUS = ("train/astra_plus/seed_0", "evaluate/astra_plus/seed_0")
pytestmark = pytest.mark.usefixtures("stages")


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "r.toml"
    path.write_text(HEAD)
    return path


@pytest.fixture
def folder(recipe: Path, stages: FakeStages) -> Path:
    made = run(recipe, root=recipe.parent)
    stages.made.clear()
    return made


def states(recipe: Path, *, verify: bool = False) -> dict[str, tuple[str, str]]:
    found = check(recipe, root=recipe.parent, verify=verify)
    return {key: (of.state, of.why) for key, of in found.items() if (of.state, of.why) != ("finished", "")}


def made_again(folder: Path) -> list[str]:
    aside = folder / "set_aside"
    return sorted(path.relative_to(aside).as_posix() for path in aside.rglob("seed_0"))


def alter(file: Path) -> None:
    whole = file.read_bytes()
    file.write_bytes(whole[:9] + b"?" + whole[10:])


def test_a_recipe_runs_whole_and_once(
    recipe: Path, tmp_path: Path, stages: FakeStages, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe.write_text(HEAD + "[train]\ntries = 5\n")
    folder = run(recipe, root=tmp_path)
    asked = stages.asked[PLUS[0]]
    assert (asked["dataset"], asked["grounding"]) == (folder / "pair/seed_0", folder / GROUND)
    assert (asked["method"], asked["seed"], asked["config"].tries) == ("astra_plus", 0, 5)
    assert stages.asked[EVALUATE]["target_encoder"] == folder / ALIGN
    assert stages.asked["report"]["recipe"].methods == ("astra", "astra_plus")
    assert json.loads((folder / "recipe.json").read_text())["train"]["tries"] == 5
    out = capsys.readouterr().out
    assert "report  finished in 1.0 s  (9 of 9)" in out and f"{EVALUATE}  done 0.50  (1 of 2 points)" in out
    assert states(recipe) == {}
    stages.made.clear()
    run(recipe, root=tmp_path)
    assert stages.made == ["report"]


def test_what_a_killed_run_left_is_removed_by_the_next(recipe: Path, folder: Path) -> None:
    left, staged = folder / "collect/.seed_0.tmp-999999999", folder / "collect/.seed_1.staged"
    for place in (left / "episodes", staged):
        place.mkdir(parents=True)
    run(recipe, root=recipe.parent)
    assert not left.exists() and staged.exists()


def test_a_failed_run_keeps_what_is_finished_and_goes_on(recipe: Path, tmp_path: Path, stages: FakeStages) -> None:
    recipe.write_text(HEAD.replace("[0]", "[0, 1]"))
    stages.failing = {"train/astra/seed_1"}
    with pytest.raises(BadInputError, match=r"^train/astra/seed_1: told to fail$"):
        run(recipe, root=tmp_path)
    before = [*stages.made]
    assert not (tmp_path / "r/train/astra/seed_1").exists()
    stages.failing, stages.made = set(), []
    run(recipe, root=tmp_path)
    assert "train/astra/seed_1" in stages.made and not set(before[:-1]) & set(stages.made)


def test_a_folder_in_use_is_left_alone(
    recipe: Path, tmp_path: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_again(*_: object, **__: object) -> None:
        with pytest.raises(BadInputError, match="is in use by another run: wait until it ends, or stop it"):
            run_stage(recipe, "collect", root=tmp_path)

    monkeypatch.setattr("astra_data.pipeline.run.digests_of", run_again)
    run(recipe, root=tmp_path, until="collect")
    assert stages.made == ["collect/seed_0"]


def test_damage_is_set_aside_and_made_again_with_what_was_made_from_it(
    recipe: Path, folder: Path, stages: FakeStages, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = folder / TRAIN / "policy.safetensors"
    whole = policy.read_bytes()
    policy.write_bytes(b"")
    why = f"policy.safetensors has 0 bytes, expected {len(whole)}"
    assert states(recipe) == {TRAIN: ("damaged", why)}
    capsys.readouterr()
    run(recipe, root=recipe.parent)
    assert policy.read_bytes() == whole and states(recipe) == {}
    aside = folder / "set_aside/1"
    assert capsys.readouterr().out.splitlines()[:2] == [
        f"{TRAIN} is recreated: damaged ({why}); the old one is in {aside / TRAIN}",
        f"{EVALUATE} is recreated: made from {TRAIN}; the old one is in {aside / EVALUATE}",
    ]
    assert (aside / TRAIN / "policy.safetensors").read_bytes() == b"" and stages.made == [TRAIN, EVALUATE, "report"]
    (folder / EVALUATE / "evaluation.json").unlink()
    run(recipe, methods=["astra_plus"], root=recipe.parent, until="evaluate")
    assert [line["method"] for line in lines(folder)] == ["astra_plus"]
    run_stage(recipe, "evaluate", root=recipe.parent)
    assert [line["method"] for line in lines(folder)] == ["astra", "astra_plus"]
    assert made_again(folder) == [f"1/{EVALUATE}", f"1/{TRAIN}", f"2/{EVALUATE}"]


def test_what_was_made_of_a_policy_that_is_another_now_is_made_again_at_once(
    recipe: Path, folder: Path, stages: FakeStages
) -> None:
    shutil.rmtree(folder / TRAIN)
    manifest = folder / EVALUATE / MANIFEST
    edit_json(manifest, made_from=json.loads(manifest.read_text())["made_from"] | {"policy": "the one that was there"})
    run(recipe, root=recipe.parent)
    assert stages.made == [TRAIN, "report", EVALUATE, "report"] and states(recipe) == {}


def test_a_diagnosis_of_other_pairs_does_not_stay(recipe: Path, folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    (folder / "diagnosis.md").touch()
    run(recipe, root=recipe.parent, until="pair")
    assert "diagnosis.md is not written: " in caplog.text and not (folder / "diagnosis.md").exists()


def test_the_page_of_errors_is_of_what_rows_and_tests_need(recipe: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("astra_data.pipeline.run.write_held_out", written := Mock())
    recipe.write_text(HEAD.replace('"astra_plus"', '"nas", "direct_transfer"'))
    run(recipe, methods=["astra", "direct_transfer"], root=recipe.parent, until="ground")
    assert written.call_args.args[2].methods == ("astra", "nas")


def test_altered_bytes_are_found_where_a_step_reads_them(recipe: Path, folder: Path, stages: FakeStages) -> None:
    grounding = folder / GROUND / "grounding.safetensors"
    whole = grounding.read_bytes()
    alter(grounding)
    assert states(recipe) == {}
    assert states(recipe, verify=True)[GROUND] == ("damaged", "grounding.safetensors was altered")
    run(recipe, root=recipe.parent)
    assert stages.made == ["report"], "no step reads the grounding"
    shutil.rmtree(folder / PLUS[1])
    run(recipe, root=recipe.parent)
    assert grounding.read_bytes() == whole
    # All of these are made from it; the same bytes again, evaluations of others would do.
    assert {GROUND, TRAIN, ALIGN, PLUS[0]} <= set(stages.made) and "pair/seed_0" not in stages.made


def test_altered_values_of_a_dataset_are_made_again_once_a_step_reads_them(
    recipe: Path, folder: Path, stages: FakeStages
) -> None:
    (data,) = (folder / "collect/seed_0/data").rglob("*.parquet")
    alter(data)
    run(recipe, root=recipe.parent)
    assert stages.made == ["report"], "no step reads the episodes"
    shutil.rmtree(folder / "pair/seed_0")
    run(recipe, root=recipe.parent)
    assert stages.made[:3] == ["report", "collect/seed_0", "pair/seed_0"] and states(recipe) == {}


def test_a_damaged_dataset_that_no_stage_made_is_not_replaced(recipe: Path, folder: Path) -> None:
    (folder / "made_with/collect/seed_0.json").unlink()
    (description := folder / "collect/seed_0/meta/astra/dataset.json").write_text("{")
    with pytest.raises(BadInputError, match=r"collect/seed_0 is damaged .* and was not made by this recipe: restore"):
        run(recipe, root=recipe.parent)
    assert description.read_text() == "{" and not (folder / "set_aside").exists()


def test_an_artifact_of_another_input_is_stale(recipe: Path, folder: Path, stages: FakeStages) -> None:
    recipe.write_text(HEAD.replace("[0]", "[0, 1]"))
    run(recipe, root=recipe.parent)
    assert states(recipe) == {}
    for one, other in (("seed_0", "aside"), ("seed_1", "seed_0"), ("aside", "seed_1")):
        (folder / "collect" / one).rename(folder / "collect" / other)
    stages.made.clear()
    stale = ("stale", "made from another collect/seed_0")
    assert states(recipe)["pair/seed_0"] == stale
    shutil.rmtree(folder / "ground")
    with pytest.raises(MissingStageError, match=r"pair/seed_0 is stale \(made from another collect/seed_0\)"):
        run_stage(recipe, "ground", seeds=[0], root=recipe.parent)
    run(recipe, root=recipe.parent, until="pair")
    assert stages.made == ["pair/seed_0", "pair/seed_1"]


def test_manifests_that_are_missing_or_damaged_and_files_that_are_foreign(recipe: Path, folder: Path) -> None:
    (folder / ALIGN / MANIFEST).unlink()
    (folder / TRAIN / MANIFEST).write_text("{")
    found = states(recipe)
    assert found[ALIGN] == ("damaged", "manifest.json is missing")
    assert found[TRAIN][0] == "damaged" and found[TRAIN][1].startswith("manifest.json cannot be read")
    assert found.keys() >= {ALIGN, TRAIN} and GROUND not in found


def test_a_stage_alone_reads_nothing_missing_and_nothing_altered(
    recipe: Path, tmp_path: Path, stages: FakeStages
) -> None:
    with pytest.raises(MissingStageError) as caught:
        run_stage(recipe, "train", methods=["astra"], root=tmp_path)
    missing = f"{tmp_path / 'r/pair/seed_0'} is missing: run `astra-data pair {recipe} --root {tmp_path}`"
    assert str(caught.value) == f"{missing} first"
    run(recipe, root=tmp_path, until="ground")
    stages.made.clear()
    run_stage(recipe, "train", methods=["astra_plus"], root=tmp_path)
    assert stages.made == [PLUS[0]]
    alter(tmp_path / "r" / GROUND / "grounding.safetensors")
    with pytest.raises(MissingStageError, match=r"damaged \(grounding.safetensors was altered\): run `astra"):
        run_stage(recipe, "train", root=tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stage": "trian"}, "unknown stage 'trian': did you mean 'train'?"),
        ({"stage": "train", "methods": ["astr"]}, "the recipe has no method 'astr': did you mean 'astra'?"),
        ({"stage": "augment"}, "the recipe has no stage 'augment'"),
        ({"stage": "pair", "methods": ["astra"]}, "astra has no stage 'pair'"),
        ({"stage": "train", "seeds": [0, 3]}, "the recipe has no seed 3; its seeds: 0"),
        ({"stage": "collect", "device": "gpu"}, "expected a device such as cpu, cuda or cuda:1, got 'gpu'"),
    ],
)
def test_bad_arguments(recipe: Path, tmp_path: Path, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(BadInputError, match=f"^{re.escape(message)}$"):
        run_stage(recipe, root=tmp_path, **arguments)


def test_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    check_device("cuda:0")
    check_device("cuda", "ray")
    for device, engine in (("cuda:1", "processes"), ("cuda:1", "ray"), ("mps", "ray"), ("cpu", "threads")):
        with pytest.raises(BadInputError):
            check_device(device, engine)
    with pytest.raises(BadInputError, match="--address is for --engine ray"):
        check_device("cpu", address="head:6379")


@pytest.mark.parametrize(("engine", "device"), [("processes", "cuda:0"), ("ray", "cpu")])
def test_a_task_is_walked_through_where_its_policies_are_trained(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, engine: str, device: str
) -> None:
    """A cluster's machines have GPUs that this one may lack."""
    told: list[str] = []
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    monkeypatch.setattr("astra_data.pipeline.run.TASKS", {})

    def walked_through(task: Task, on: str) -> list[str]:
        told.append(on)
        return ["fault"]

    monkeypatch.setattr("astra_data.pipeline.run.check_task", walked_through)
    with pytest.raises(BadInputError, match="task antmaze-umaze: fault"):
        given = "cuda" if engine == "ray" else device
        experiment = load_experiment(recipe, tmp_path)
        make(experiment, (), (), selected(experiment.recipe), device=given, engine=engine)
    assert told == [device]


def test_some_seeds_and_what_other_machines_ran_is_copied_together(
    recipe: Path, tmp_path: Path, stages: FakeStages
) -> None:
    recipe.write_text(HEAD.replace("[0]", "[0, 1, 2]"))
    ours, theirs = (run(recipe, seeds=seeds, root=tmp_path / str(seeds[0])) for seeds in ([2, 0], [1]))
    reported = stages.asked["report"]
    assert reported["recipe"].seeds == (0, 1, 2) and reported["command"] == f"astra-data run {recipe}"
    shutil.copytree(theirs, ours, dirs_exist_ok=True)
    stages.made.clear()
    run(recipe, root=tmp_path / "2")
    assert stages.made == ["report"] and stages.asked["report"]["recipe"].seeds == (0, 1, 2)


def test_a_recipe_with_data_is_labeled_and_has_nothing_to_collect(
    recipe: Path, tmp_path: Path, stages: FakeStages
) -> None:
    recipe.write_text('data = "me/walks"\n' + HEAD)
    with pytest.raises(BadInputError, match=r"r\.toml uses the data me/walks: there is nothing to collect"):
        run_stage(recipe, "collect", root=tmp_path)
    folder = run(recipe, root=tmp_path, until="pair")
    assert stages.asked["label/seed_0"]["data"] == "me/walks"
    assert stages.asked["pair/seed_0"]["dataset"] == folder / "label/seed_0"
    recipe.write_text('data = "you/walks"\n' + HEAD)
    with pytest.raises(RecipeError, match=r'data \("me/walks", now "you/walks"\) changed in the recipe since'):
        run(recipe, root=tmp_path, until="pair")


def test_a_choice_is_asked_for_by_its_table_and_made_again_with_more_policies(
    recipe: Path, tmp_path: Path, stages: FakeStages
) -> None:
    rows = 'task = "antmaze-umaze"\nmethods = ["nas"]\nseeds = [0, 1]\n'
    recipe.write_text(rows)
    folder = run(recipe, root=tmp_path)
    assert "select" not in stages.made
    recipe.write_text(rows + "[select]\nepisodes = 2\n")
    stages.made.clear()
    run(recipe, root=tmp_path)
    assert stages.made == ["select", "report"] and states(recipe) == {}
    recipe.write_text(rows + "[select]\nepisodes = 3\n")
    with pytest.raises(RecipeError, match=rf"select \(episodes: 2, now 3\) changed .* remove {folder}/select$"):
        run(recipe, root=tmp_path)
    recipe.write_text(rows.replace("1]", "1, 2]") + "[select]\nepisodes = 2\n")
    assert states(recipe)["select"] == ("stale", "made without train/nas/seed_2")
    run(recipe, root=tmp_path)
    assert (folder / "set_aside/1/select").is_dir() and states(recipe) == {}


def changed(recipe: Path, text: str) -> list[str]:
    """Return what a run with another text of the recipe asks to remove; nothing if it does not refuse."""
    recipe.write_text(text)
    found = {key for key, of in check(recipe, root=recipe.parent).items() if of.state == "stale"}
    try:
        load_experiment(recipe, recipe.parent).check_unchanged()
    except RecipeError as error:
        assert found
        folder = f"{recipe.parent / recipe.stem}/"
        return [place.removeprefix(folder) for place in str(error).partition(" or remove ")[2].split()]
    assert not found
    return []


@pytest.mark.parametrize(
    ("table", "stale"),
    [
        (
            "[collect]\nepisodes = 7",
            ["align", "collect", *(f"evaluate/{row}" for row in MADE_OF_DATA), "ground", "pair", "train"],
        ),
        (
            "[ground]\nupdates = 7",
            ["align", "evaluate/astra", "evaluate/astra_plus", "ground", "train/astra", "train/astra_plus"],
        ),
        ("[align]\nupdates = 7", ["align", "evaluate/astra", "evaluate/astra_plus"]),
        ("[train]\ntries = 7", [*(f"evaluate/{row}" for row in MADE_OF_DATA), "train"]),
        ("[target]\nnum_envs = 7", ["evaluate/target", "train/target"]),
        ("[evaluate]\nepisodes = 7", ["evaluate"]),
        ("[rma]\nextrinsics_size = 7\n[report]\ntrajectory_episodes = 7", []),
    ],
)
def test_other_settings_are_refused_where_something_was_made_with_the_old_ones(
    recipe: Path, stages: FakeStages, table: str, stale: list[str]
) -> None:
    text = HEAD.replace('"astra_plus"', '"astra_plus", "target", "follower"')
    recipe.write_text(text)
    folder = run(recipe, root=recipe.parent)
    assert changed(recipe, f"{text}{table}\n") == stale
    with pytest.raises(RecipeError) if stale else pytest.MonkeyPatch.context():
        run(recipe, root=recipe.parent)
    for place in stale:
        shutil.rmtree(folder / place)
    stages.made.clear()
    run(recipe, root=recipe.parent)
    assert {key for key in stages.made if key != "report"} == {
        key for key in load_experiment(recipe, folder).items if any(key.startswith(f"{one}/") for one in stale)
    }
    assert states(recipe) == {}


def test_changes_are_told_key_by_key_new_keys_have_their_defaults_and_old_ones_do_not_count(
    recipe: Path, folder: Path
) -> None:
    recipe.write_text(HEAD + "[train]\ntries = 7\nnum_envs = 3\n")
    with pytest.raises(RecipeError) as caught:
        run(recipe, root=recipe.parent)
    found = re.fullmatch(
        rf"train \((\w+: \S+, now \d, )?(\w+: \S+, now \d)\) changed in the recipe since {folder} was made: "
        rf"give the recipe another name, or remove {folder}/evaluate {folder}/train",
        str(caught.value),
    )
    assert found, str(caught.value)
    recipe.write_text(HEAD.replace('"astra_plus"', '"behavior_cloning"'))
    run(recipe, root=recipe.parent)
    for row, table, key in (("behavior_cloning", "behavior_cloning", "temperature"), ("astra", "train", "tries")):
        record = folder / f"made_with/train/{row}/seed_0.json"
        kept = json.loads(record.read_text())
        del kept[table][key]
        kept[table]["gone"] = 1
        record.write_text(json.dumps(kept))
    assert states(recipe) == {}
    record.write_text("[]")
    with pytest.raises(AstraDataError, match=r"seed_0\.json is not what a run writes: .*restore it"):
        check(recipe, root=recipe.parent)


def test_what_was_begun_with_other_settings_is_refused_alike(recipe: Path, tmp_path: Path, stages: FakeStages) -> None:
    stages.failing = {TRAIN}
    with pytest.raises(BadInputError):
        run(recipe, root=tmp_path)
    partial = tmp_path / "r/train/astra/.seed_0.partial"
    assert partial.is_dir() and changed(recipe, HEAD + "[train]\ntries = 9\n") == ["train"]
    found = check(recipe, root=tmp_path)
    assert found[TRAIN].why.endswith(f"or remove {partial}") and found[PLUS[0]].state == "missing"
    shutil.rmtree(partial)
    stages.failing = set()
    run(recipe, root=tmp_path)
    assert stages.asked[TRAIN]["config"].tries == 9


def test_rows_and_seeds_come_and_go_without_changing_others(recipe: Path, folder: Path) -> None:
    assert changed(recipe, HEAD.replace('"astra", "astra_plus"', '"astra", "direct_transfer"')) == []
    assert changed(recipe, HEAD.replace("[0]", "[1]")) == []
    assert changed(recipe, HEAD.replace("umaze", "long")) == ["align", "collect", "evaluate", "ground", "pair", "train"]
    recipe.write_text(HEAD.replace('"astra_plus"', '"nas"'))
    run(recipe, root=recipe.parent)
    recipe.write_text(HEAD.replace(', "astra_plus"', ""))  # tested in what NAS grounds, which the page would not say
    assert states(recipe) == {EVALUATE: ("stale", "made from another reference")}


SWEEP = HEAD.replace('"astra", "astra_plus"', '"nas", "follower"').replace("[0]", "[0, 1]") + (
    "[collect]\nepisodes = 20\n[sweep]\npercent = [50, 150]\n"
)


def lines(folder: Path) -> list[dict[str, str]]:
    with (folder / "sweep.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_sweep_goes_on_point_by_point_and_makes_shared_artifacts_once(
    recipe: Path, tmp_path: Path, stages: FakeStages
) -> None:
    recipe.write_text(SWEEP)
    part: dict[str, Any] = {"methods": ["nas"], "seeds": [1], "percents": [50], "root": tmp_path}
    folder = run(recipe, **part)
    expected = "nas 50 1 1.0 20.0 2.5 0.5 0.5 fake@data-1.0.0 hash1 abc 7.0"
    assert [list(line.values()) for line in lines(folder)] == [expected.split()]
    run(recipe, root=tmp_path)
    assert len(stages.made) == len({*stages.made}) + 1, "the report twice"
    assert [tuple(line.values())[:3] for line in lines(folder)] == [
        (row, percent, seed) for row in ("nas", "follower") for percent in ("50", "150") for seed in ("0", "1")
    ]
    shutil.rmtree(folder / "train")
    run(recipe, methods=["follower"], root=tmp_path)
    times = {line["method"]: line["wall_seconds"] for line in lines(folder)}
    assert times["nas"] == "" and float(times["follower"]) > 0
    text = SWEEP.replace("[50, 150]", "[25, 150]")
    assert changed(recipe, text) == [] and "collect" in changed(recipe, text.replace("150]", "200]"))


def test_a_report_is_added_to_what_is_published_beside_the_recipe(
    recipe: Path, tmp_path: Path, stages: FakeStages
) -> None:
    place, text = tmp_path / "results", HEAD.replace('"astra_plus"', '"target"')
    recipe.write_text(text)
    run_stage(recipe, "report", root=tmp_path, publish=True)
    asked = stages.asked["report"]
    assert (asked["publish"], asked["published"]) == (place, [])
    settings = load_experiment(recipe, tmp_path).recipe.settings
    (place / "r").mkdir(parents=True)
    lines = [line(row, 0, success=0.0) for row in ("astra", "target")]
    (place / "r/results.json").write_text(results_json(results(*lines, settings=settings)))
    run_stage(recipe, "report", root=tmp_path, publish=True)
    assert stages.asked["report"]["published"] == [place / "r/results.json"]
    run_stage(recipe, "report", root=tmp_path)
    assert stages.asked["report"]["publish"] is None
    for table in ("[report]\ntrajectory_episodes = 7\n", "[rma]\nextrinsics_size = 7\n"):
        recipe.write_text(text + table)
        assert load_experiment(recipe, tmp_path).published() == [place / "r/results.json"]
    for table, key, before in (("evaluate", "episodes", "100"), ("target", "num_envs", "none")):
        recipe.write_text(text + f"[{table}]\n{key} = 7\n")
        with pytest.raises(RecipeError, match=rf"^{table} \({key}: {before}, now 7\) changed .* since the results"):
            run_stage(recipe, "report", root=tmp_path, publish=True)
    recipe.write_text(text.replace("umaze", "long"))
    with pytest.raises(RecipeError, match=r'^task \("antmaze-umaze", now "antmaze-long"\) changed in the recipe in'):
        load_experiment(recipe, tmp_path).published()
