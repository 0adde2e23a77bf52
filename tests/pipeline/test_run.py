import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from fake_runs import bare_results
from fake_stages import asked

from astra_data.core.errors import BadInputError, MissingStageError, RecipeError
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.run import check, make, run, run_stage
from astra_data.reports.results import results_json
from astra_data.worlds.task import Task

pytestmark = pytest.mark.usefixtures("fake_recipe")


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "r.toml"
    path.write_text('task = "maze"\nmethods = ["astra", "astra_plus"]\nseeds = [0]\n[train]\nsteps = 5\n')
    return path


def test_a_recipe_runs_whole(recipe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = run(recipe, root=tmp_path, jobs=2)
    assert folder == tmp_path / "r"
    assert asked(folder / "train/astra_plus/seed_0") == {
        "task": "maze",
        "method": "astra_plus",
        "dataset": str(folder / "pair/seed_0"),
        "grounding": str(folder / "ground/astra/seed_0"),
        "initial": None,
        "seed": 0,
        "steps": 5,
    }
    assert asked(folder / "evaluate/astra/seed_0")["target_encoder"] == str(folder / "align/astra/seed_0")
    assert asked(folder / "report")["methods"] == ["astra", "astra_plus"]
    assert json.loads((folder / "recipe.json").read_text())["train"]["steps"] == 5
    lines = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"report  finished in [\d.]+ s  \(9 of 9\)", lines[-1])

    unfinished = [key for key, found in check(recipe, root=tmp_path).items() if not found.is_finished]
    assert unfinished == []
    run(recipe, root=tmp_path, jobs=1)
    assert (folder / "train/astra/seed_0/attempts").read_text() == "."


def test_what_a_killed_run_left_is_removed_by_the_next(recipe: Path, tmp_path: Path) -> None:
    folder = run(recipe, root=tmp_path, jobs=1)
    left = folder / "collect/.seed_0.tmp-999999999"
    (left / "episodes").mkdir(parents=True)
    staged = folder / "collect/.seed_1.staged"
    staged.mkdir()
    run(recipe, root=tmp_path, jobs=1)
    assert not left.exists()
    assert staged.exists()


@pytest.mark.parametrize(("jobs", "each_of_two"), [(None, 1), (1, 3)])
def test_items_side_by_side_share_the_cores(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jobs: int | None, each_of_two: int
) -> None:
    monkeypatch.setattr("astra_data.pipeline.devices.cores", lambda: 3)
    folder = run(recipe, root=tmp_path, jobs=jobs)
    assert asked(folder / "collect/seed_0")["num_threads"] == 3
    for row in ("astra", "astra_plus"):
        assert asked(folder / "evaluate" / row / "seed_0")["num_threads"] == each_of_two


def test_trainings_in_the_target_get_their_share_of_the_cores_and_one_table(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("astra_data.pipeline.devices.cores", lambda: 8)
    methods = '["direct_transfer", "target", "full_obs"]'
    recipe.write_text(f'task = "maze"\nmethods = {methods}\nseeds = [0]\n[target]\nnum_envs = 7\n')
    folder = run(recipe, root=tmp_path, jobs=2, until="train")
    for row in ("target", "full_obs"):
        told = asked(folder / "train" / row / "seed_0")
        assert told["num_threads"] == 4 and "num_envs=7" in str(told["settings"])
    assert "num_threads" not in asked(folder / "train/direct_transfer/seed_0")


@pytest.mark.parametrize(("until", "calls"), [("pair", 0), ("ground", 1), (None, 1)])
def test_every_run_that_grounds_writes_the_page_of_errors(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, until: str | None, calls: int
) -> None:
    told: list[object] = []
    monkeypatch.setattr("astra_data.pipeline.run.write_errors", lambda *given: told.append(given))
    run(recipe, root=tmp_path, jobs=1, until=until)
    assert len(told) == calls


def test_a_stage_may_make_what_its_own_items_read(recipe: Path, tmp_path: Path) -> None:
    recipe.write_text('task = "maze"\nmethods = ["fine_tuned"]\nseeds = [0]\n')
    run(recipe, root=tmp_path, until="pair")
    folder = run_stage(recipe, "train", root=tmp_path)
    assert asked(folder / "fine_tuned/seed_0")["initial"] == str(folder / "direct_transfer/seed_0")


@pytest.mark.parametrize(("device", "jobs"), [("cpu", 5), ("cuda:0", 2)])
def test_few_items_at_a_time_hold_a_context_of_a_gpu(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str, jobs: int
) -> None:
    told: list[int] = []
    monkeypatch.setattr("astra_data.pipeline.devices.cores", lambda: 5)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    monkeypatch.setattr("astra_data.pipeline.run.execute", lambda *_, jobs, **__: told.append(jobs))
    run(recipe, root=tmp_path, device=device)
    run(recipe, root=tmp_path, device=device, jobs=3)
    assert told == [jobs, 3]


def test_networks_compute_on_the_device_that_is_asked_for(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(recipe, root=tmp_path, jobs=1, until="pair")
    told: list[tuple[str, str]] = []
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    monkeypatch.setattr(
        "astra_data.pipeline.run.execute",
        lambda items, **_: told.extend((item.key, item.device) for item in items),
    )
    run(recipe, root=tmp_path, device="cuda:0", until="ground")
    run_stage(recipe, "ground", root=tmp_path, device="cuda:0")
    assert told == [("ground/astra/seed_0", "cuda:0")] * 2


@pytest.mark.parametrize(("cluster", "walked"), [(None, "cuda:0"), ("auto", "cpu")])
def test_a_task_is_walked_through_where_its_policies_are_trained(
    recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cluster: str | None, walked: str
) -> None:
    """A cluster's machines have GPUs that this one may lack."""
    told: list[str] = []
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    monkeypatch.setattr("astra_data.pipeline.run.TASKS", {})

    def walked_through(task: Task, device: str) -> list[str]:
        told.append(device)
        return []

    monkeypatch.setattr("astra_data.pipeline.run.check_task", walked_through)
    for way in ("execute", "execute_on_cluster"):
        monkeypatch.setattr(f"astra_data.pipeline.run.{way}", lambda *_, **__: None)
    device = "cuda" if cluster else "cuda:0"
    experiment = load_experiment(recipe, tmp_path)
    make(experiment, (), (), jobs=1, device=device, cluster=cluster)
    assert told == [walked]


@pytest.mark.parametrize("stage", ["ground", "align"])
def test_a_row_is_grounded_and_aligned_as_its_method(recipe: Path, tmp_path: Path, stage: str) -> None:
    with pytest.raises(MissingStageError, match="pair/seed_0 is missing"):
        run_stage(recipe, stage, methods=["astra_plus"], root=tmp_path)


def test_several_rows_of_a_stage(recipe: Path, tmp_path: Path) -> None:
    rows = ["direct_transfer", "astra", "astra_plus"]
    recipe.write_text(
        recipe.read_text().replace('"astra", "astra_plus"', ", ".join(f'"{row}"' for row in rows))
    )
    run(recipe, root=tmp_path, until="ground")
    folder = run_stage(recipe, "train", methods=["direct_transfer", "astra_plus"], root=tmp_path)
    assert sorted(row.name for row in folder.iterdir()) == ["astra_plus", "direct_transfer"]
    with pytest.raises(BadInputError, match=r"^direct_transfer has no stage 'align'$"):
        run_stage(recipe, "align", methods=["astra", "direct_transfer"], root=tmp_path)


def test_a_failed_run_goes_on_where_it_stopped(recipe: Path, tmp_path: Path) -> None:
    text = recipe.read_text()
    recipe.write_text(text + "[pair]\nfails = true\n")
    with pytest.raises(BadInputError, match=r"^pair/seed_0: told to fail$"):
        run(recipe, root=tmp_path, jobs=1)
    assert (tmp_path / "r/collect/seed_0").is_dir()
    assert not (tmp_path / "r/pair/seed_0").exists()
    (tmp_path / "r/recipe.json").unlink()
    recipe.write_text(text)
    run(recipe, root=tmp_path, jobs=1, until="pair")
    assert (tmp_path / "r/pair/seed_0/attempts").read_text() == ".."
    assert not (tmp_path / "r/ground").exists()


def test_a_folder_in_use_is_left_alone(recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "r"

    def files() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}

    def run_again(*_: object, **__: object) -> None:
        before = files()
        with pytest.raises(BadInputError) as caught:
            run_stage(recipe, "collect", root=tmp_path)
        assert str(caught.value) == f"{folder} is in use by another run: wait until it ends, or stop it"
        assert files() == before

    with monkeypatch.context() as patched:
        patched.setattr("astra_data.pipeline.run.execute", run_again)
        run(recipe, root=tmp_path)
    run_stage(recipe, "collect", root=tmp_path, jobs=1)
    assert (folder / "collect/seed_0").is_dir()


def test_a_stage_needs_the_stages_before_it(recipe: Path, tmp_path: Path) -> None:
    with pytest.raises(MissingStageError) as caught:
        run_stage(recipe, "train", methods=["astra"], root=tmp_path)
    root = tmp_path / "r"
    assert str(caught.value) == (
        f"{root / 'pair/seed_0'} is missing: run `astra-data pair {recipe} --root {tmp_path}` first"
    )


@pytest.mark.parametrize(
    ("stage", "part", "fault"),
    [
        ("report", "evaluate/astra/seed_1/evaluation.json", r"damaged \(evaluation.json was altered\)"),
        ("evaluate", "train/astra/seed_0/policy.safetensors", r"damaged \(policy.safetensors was altered\)"),
        ("train", "ground/astra", r"stale \(made from another pair/seed_0\)"),
        ("evaluate", "align/astra", r"stale \(made from another pair/seed_0\)"),
    ],
)
def test_a_stage_alone_reads_nothing_altered_and_nothing_swapped(
    recipe: Path, tmp_path: Path, stage: str, part: str, fault: str
) -> None:
    recipe.write_text('task = "maze"\nmethods = ["astra"]\nseeds = [0, 1]\n')
    place = run(recipe, root=tmp_path, jobs=2) / part
    if place.is_file():
        place.write_bytes(place.read_bytes().swapcase())
    else:
        for one, other in (("seed_0", "aside"), ("seed_1", "seed_0"), ("aside", "seed_1")):
            (place / one).rename(place / other)
    if stage != "report":
        shutil.rmtree(tmp_path / "r" / stage)
    with pytest.raises(MissingStageError, match=f"/{part.partition('/seed')[0]}/seed_. is {fault}: run"):
        run_stage(recipe, stage, root=tmp_path, jobs=1)


def test_moved_copies_are_made_by_running_the_recipe(recipe: Path, tmp_path: Path) -> None:
    recipe.write_text(recipe.read_text() + "[augment]\nsteps = 4\n")
    run_stage(recipe, "collect", root=tmp_path)
    missing = tmp_path / "r/augment/seed_0"
    message = f"{missing} is missing: run `astra-data run {recipe} --root {tmp_path}` first"
    with pytest.raises(MissingStageError, match=f"^{re.escape(message)}$"):
        run_stage(recipe, "pair", root=tmp_path)


def test_a_report_does_not_wait_for_every_seed(recipe: Path, tmp_path: Path) -> None:
    run_stage(recipe, "report", root=tmp_path)
    assert asked(tmp_path / "r/report")["seeds"] == [0]


def test_a_report_is_published_beside_the_recipe_and_added_to_what_is_there(
    recipe: Path, tmp_path: Path
) -> None:
    results = tmp_path / "results"
    run_stage(recipe, "report", root=tmp_path, jobs=1, publish=True)
    told = asked(tmp_path / "r/report")
    assert (told["publish"], told["published"]) == (str(results), [])
    settings = load_experiment(recipe, tmp_path).recipe.settings
    results.mkdir(exist_ok=True)
    (results / "r.json").write_text(results_json(bare_results("r", {"astra": [0]}, settings)))
    run_stage(recipe, "report", root=tmp_path, jobs=1, publish=True)
    assert asked(tmp_path / "r/report")["published"] == [str(results / "r.json")]
    run_stage(recipe, "report", root=tmp_path, jobs=1)
    assert (told := asked(tmp_path / "r/report"))["publish"] is None and told["published"] == []
    recipe.write_text(recipe.read_text() + "[evaluate]\nsteps = 7\n")
    with pytest.raises(RecipeError, match=r"^evaluate changed in .* since the results in .*r.json were made"):
        run_stage(recipe, "report", root=tmp_path, publish=True)


def test_a_changed_recipe_does_not_mix_with_what_the_old_one_made(recipe: Path, tmp_path: Path) -> None:
    text, folder = recipe.read_text(), tmp_path / "r"
    run(recipe, root=tmp_path, jobs=2)
    recipe.write_text(text.replace("steps = 5", "steps = 6"))
    stale = {key: found.why for key, found in check(recipe, root=tmp_path).items() if found.state == "stale"}
    rows = ("astra", "astra_plus")
    assert stale == dict.fromkeys(
        [f"{stage}/{row}/seed_0" for stage in ("train", "evaluate") for row in rows],
        "train (steps: 5, now 6) changed in the recipe since: give the recipe another name, or remove this",
    )
    with pytest.raises(RecipeError) as caught:
        run(recipe, root=tmp_path)
    assert str(caught.value) == (
        f"train (steps: 5, now 6) changed in the recipe since {folder} was made: "
        f"give the recipe another name, or remove {folder / 'train'} {folder / 'evaluate'}"
    )
    shutil.rmtree(folder / "train")
    shutil.rmtree(folder / "evaluate")
    assert sorted(key for key, found in check(recipe, root=tmp_path).items() if not found.is_finished) == [
        f"{stage}/{row}/seed_0" for stage in ("evaluate", "train") for row in rows
    ]
    recipe.write_text(text.replace("seeds = [0]", "seeds = [0, 1]"))
    assert check(recipe, root=tmp_path)["collect/seed_1"].state == "missing"


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
    with pytest.raises(BadInputError) as caught:
        run_stage(recipe, root=tmp_path, **arguments)
    assert str(caught.value) == message


def test_some_seeds_of_a_recipe(recipe: Path, tmp_path: Path) -> None:
    recipe.write_text(recipe.read_text().replace("seeds = [0]", "seeds = [0, 1, 2]"))
    folder = run(recipe, seeds=[2, 0], root=tmp_path, jobs=2)
    assert sorted(path.name for path in (folder / "evaluate/astra").iterdir()) == ["seed_0", "seed_2"]
    told = asked(folder / "report")
    assert told["seeds"] == [2, 0]
    assert told["command"] == f"astra-data run {recipe} --seed 2 --seed 0"
    run_stage(recipe, "pair", seeds=[0], root=tmp_path)
    with pytest.raises(MissingStageError, match="collect/seed_1 is missing"):
        run_stage(recipe, "pair", root=tmp_path)


def test_seeds_that_other_machines_ran_are_copied_together(recipe: Path, tmp_path: Path) -> None:
    recipe.write_text(recipe.read_text().replace("seeds = [0]", "seeds = [0, 1]"))
    ours, theirs = (run(recipe, seeds=[seed], root=tmp_path / f"machine{seed}", jobs=1) for seed in (0, 1))
    shutil.copytree(theirs, ours, dirs_exist_ok=True)
    run(recipe, root=tmp_path / "machine0", jobs=1)
    made = [ours / f"train/astra_plus/seed_{seed}/attempts" for seed in (0, 1)]
    assert [path.read_text() for path in made] == [".", "."]
    assert asked(ours / "report")["seeds"] == [0, 1]


def test_a_recipe_with_data_is_labeled_and_has_nothing_to_collect(recipe: Path, tmp_path: Path) -> None:
    recipe.write_text('data = "me/walks"\n' + recipe.read_text())
    with pytest.raises(BadInputError, match=r"r\.toml uses the data me/walks: there is nothing to collect"):
        run_stage(recipe, "collect", root=tmp_path)
    folder = run(recipe, root=tmp_path, jobs=1, until="pair")
    assert asked(folder / "label/seed_0")["data"] == "me/walks"
    assert asked(folder / "pair/seed_0")["dataset"] == str(folder / "label/seed_0")
    recipe.write_text(recipe.read_text().replace('"me/walks"', '"runs"'))
    with pytest.raises(RecipeError, match=r'data \("me/walks", now ".*runs"\) changed in the recipe since'):
        run(recipe, root=tmp_path, jobs=1, until="pair")
    (tmp_path / "runs/meta").mkdir(parents=True)
    (tmp_path / "runs/meta/info.json").touch()
    with pytest.raises(RecipeError, match=r'data \("me/walks", now ".*runs"\) changed'):
        run(recipe, root=tmp_path, jobs=1, until="pair")
    assert load_experiment(recipe, tmp_path).recipe.data == str(tmp_path / "runs")
