import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import fake_stages
import pytest
from fake_runs import bare_results
from fake_stages import asked
from typer.testing import CliRunner

from astra_data.cli import app as cli
from astra_data.core.errors import BadInputError, MissingStageError, RecipeError
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.run import check, run, run_stage
from astra_data.reports.results import results_json
from astra_data.robots.registry import TASKS

pytestmark = pytest.mark.usefixtures("fake_recipe")

KNOWN = f"{', '.join([*TASKS, 'maze'])}; name your own task like cart.py:TASK"
BASE = 'task = "maze"\nmethods = ["astra", "astra_plus", "follower"]\nseeds = [0, 1]\n[evaluate]\nsteps = 3\n'
LONGER = 'based_on = "base"\n[evaluate]\nrate = 2.0\n'


@pytest.fixture
def base(tmp_path: Path) -> Path:
    path = tmp_path / "base.toml"
    path.write_text(BASE)
    return path


@pytest.fixture
def longer(base: Path) -> Path:
    path = base.with_name("longer.toml")
    path.write_text(LONGER)
    return path


def attempts(folder: Path) -> int:
    return sum(len(path.read_text()) for path in folder.rglob("attempts"))


def test_what_only_some_rows_read_leaves_the_others_alone(base: Path, tmp_path: Path) -> None:
    folder = run(base, root=tmp_path, jobs=2)
    base.write_text(BASE + "[align]\nrate = 2.0\n")
    with pytest.raises(RecipeError) as caught:
        run(base, root=tmp_path)
    rows = [folder / "align", folder / "evaluate/astra", folder / "evaluate/astra_plus"]
    assert str(caught.value) == (
        f"align (rate: 0.5, now 2.0) changed in the recipe since {folder} was made: "
        f"give the recipe another name, or remove {' '.join(map(str, rows))}"
    )
    made = attempts(folder)
    for row in rows:
        shutil.rmtree(row)
    run(base, root=tmp_path, jobs=2)
    assert attempts(folder) == made


def test_the_base_has_published_what_is_borrowed_of_it(base: Path, longer: Path) -> None:
    part = base.with_name("part.toml")
    part.write_text('based_on = "base"\nmethods = ["astra"]\n')
    settings = load_experiment(base, base.parent).recipe.settings
    (base.parent / "results").mkdir()
    for name in ("base", "part"):
        (base.parent / f"results/{name}.json").write_text(results_json(bare_results(name, {}, settings)))
    for path, expected in ((base, ["base"]), (longer, []), (part, ["base", "part"])):
        found = load_experiment(path, base.parent).published()
        assert found == [base.parent / f"results/{name}.json" for name in expected]


@pytest.mark.parametrize(
    ("text", "borrowed"),
    [
        ("", ["collect", "pair", "ground", "train", "align", "evaluate"]),
        ("seeds = [1]\nmethods = ['follower']\n[report]\nsteps = 2\n[evaluate]\nsteps = 3\n", None),
        ("[evaluate]\nrate = 2.0\n", ["collect", "pair", "ground", "train", "align"]),
        ("[train]\nrate = 2.0\n", ["collect", "pair", "ground", "align"]),
        ("[target]\nnum_envs = 3\n", ["collect", "pair", "ground", "align"]),
        ("[align]\nrate = 2.0\n", ["collect", "pair", "ground", "train"]),
        ("[ground]\nrate = 2.0\n", ["collect", "pair"]),
        ("[collect]\nrate = 2.0\n", []),
    ],
)
def test_what_differs_and_what_reads_it_is_made_anew(
    base: Path, text: str, borrowed: list[str] | None
) -> None:
    path = base.with_name("other.toml")
    path.write_text(f'based_on = "base"\n{text}')
    experiment = load_experiment(path, base.parent)
    every = {"collect", "pair", "ground", "train", "align", "evaluate"}
    assert experiment.borrowed == (every if borrowed is None else set(borrowed))
    assert experiment.recipe.task == "maze"
    assert experiment.place("pair/seed_0").parts[-3] == ("other" if borrowed == [] else "base")


@pytest.mark.parametrize(
    ("theirs", "ours", "is_borrowed"),
    [
        ("", "[25, 100]", False),
        ("[25, 100]", "[25, 50, 100]", False),
        ("[25, 100]", "[100]", True),
        ("[25, 100]", "[25, 100]", True),
        ("[25, 100]", "[]", False),
    ],
)
def test_sizes_that_the_base_has_not_are_made_of_its_pairs(
    base: Path, theirs: str, ours: str, is_borrowed: bool
) -> None:
    base.write_text(BASE + (f"[sweep]\npercent = {theirs}\n" if theirs else ""))
    path = base.with_name("other.toml")
    path.write_text(f'based_on = "base"\n[sweep]\npercent = {ours}\n')
    borrowed = load_experiment(path, base.parent).borrowed
    every = {"collect", "pair", "subset", "ground", "train", "align", "evaluate"}
    assert borrowed == (every if is_borrowed else {"collect", "pair"})


def test_data_replace_what_the_base_collects_and_the_other_way_around(base: Path) -> None:
    collects, given = "[collect]\nsteps = 7\n", 'data = "walks"\n'
    path = base.with_name("other.toml")
    for theirs, ours in ((BASE + collects, given), (given + BASE, collects)):
        base.write_text(theirs)
        path.write_text(f'based_on = "base"\n{ours}')
        experiment = load_experiment(path, base.parent)
        assert experiment.borrowed == set()
        found = experiment.recipe
        assert (found.data, found.collect and found.collect.steps) == (
            ("walks", None) if ours == given else (None, 7)
        )
        path.write_text(f'based_on = "base"\n{given}{collects}')
        with pytest.raises(RecipeError, match=r"data replaces \[collect\]: leave out one of them$"):
            load_experiment(path, base.parent)


def sketch(base: Path, monkeypatch: pytest.MonkeyPatch, *targets: str | None) -> Path:
    """Write a recipe based on `base` of another task; both have these targets."""
    maze = TASKS["antmaze-umaze"]
    for name, target in zip(("maze", "sketch"), targets, strict=True):
        monkeypatch.setitem(TASKS, name, replace(maze, name=name, target_id=target))
    path = base.with_name("other.toml")
    path.write_text('based_on = "base"\ntask = "sketch"\nmethods = ["follower"]\nseeds = [1]\n')
    return path


def test_a_task_of_the_same_target_shares_the_episodes(
    base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = sketch(base, monkeypatch, "ant", "ant")
    assert load_experiment(path, base.parent).borrowed == {"collect"}
    command = f"astra-data collect {base} --root {tmp_path}"
    with pytest.raises(MissingStageError, match=f"run `{re.escape(command)}` first"):
        run(path, root=tmp_path)
    run_stage(base, "collect", root=tmp_path)
    folder = run(path, root=tmp_path, jobs=1)
    assert asked(folder / "collect/seed_1")["task"] == "maze"
    assert asked(folder / "pair/seed_1")["task"] == "sketch"
    assert attempts(tmp_path / "base") == 2


@pytest.mark.parametrize("other", [("ant", "other ant"), (None, None)])
def test_a_task_of_another_target_does_not_fit(
    base: Path, other: tuple[str | None, str | None], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = sketch(base, monkeypatch, *other)
    with pytest.raises(RecipeError, match=r"'maze', or one with the same target, got 'sketch'$"):
        load_experiment(path, base.parent)


def test_tables_lie_over_those_of_the_base(base: Path, longer: Path) -> None:
    recipe = load_experiment(longer, base.parent).recipe
    assert recipe.evaluate.model_dump() == fake_stages.FakeConfig(steps=3, rate=2.0).model_dump()
    assert recipe.methods == ("astra", "astra_plus", "follower")
    assert recipe.based_on == "base"


def test_a_run_reads_what_the_base_made_and_makes_only_the_rest(
    base: Path, longer: Path, tmp_path: Path
) -> None:
    with pytest.raises(MissingStageError) as caught:
        run(longer, root=tmp_path)
    assert str(caught.value) == (
        f"{tmp_path / 'base/train/astra/seed_0'} is missing: "
        f"run `astra-data run {base} --root {tmp_path}` first"
    )
    run(base, root=tmp_path, jobs=2)
    made = attempts(tmp_path / "base")
    finished = check(longer, root=tmp_path)
    assert finished["train/astra_plus/seed_1"].is_finished
    assert finished["evaluate/astra_plus/seed_1"].state == "missing"
    assert not (tmp_path / "longer/train").exists()

    folder = run(longer, root=tmp_path, jobs=2)
    assert sorted(path.name for path in folder.iterdir() if path.is_symlink()) == sorted(
        ["collect", "pair", "ground", "train", "align"]
    )
    assert (folder / "train").resolve() == (tmp_path / "base/train").resolve()
    assert attempts(tmp_path / "base") == made
    told = asked(folder / "evaluate/astra_plus/seed_1")
    assert told["policy"] == str(folder / "train/astra_plus/seed_1")
    assert told["steps"] == 3 and Path(str(told["policy"])).is_dir()
    assert json.loads((folder / "recipe.json").read_text())["evaluate"]["rate"] == 2.0
    assert all(found.is_finished for found in check(longer, root=tmp_path).values())
    run(longer, root=tmp_path, jobs=1)
    assert (folder / "evaluate/astra/seed_0/attempts").read_text() == "."
    # Links and all, the runs may be moved.
    shutil.move(tmp_path / "base", tmp_path / "moved/base")
    shutil.move(tmp_path / "longer", tmp_path / "moved/longer")
    assert (tmp_path / "moved/longer/train/astra/seed_0").is_dir()


def test_a_stage_of_the_base_is_not_run_here(base: Path, longer: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as caught:
        run_stage(longer, "train", root=tmp_path)
    assert str(caught.value) == (f"{longer} uses the train of {base}: run `astra-data train {base}` instead")
    with pytest.raises(
        MissingStageError, match=r"base/train/astra/seed_0 is missing: run `astra-data run .*base"
    ):
        run_stage(longer, "evaluate", root=tmp_path)
    result = CliRunner().invoke(cli.app, ["check", str(longer), "--root", str(tmp_path)])
    assert "  to do     train/astra/seed_0\n" in result.output


def test_changes_are_told_in_the_base_and_here(base: Path, longer: Path, tmp_path: Path) -> None:
    run(base, root=tmp_path, jobs=2)
    folder = run(longer, root=tmp_path, jobs=2)
    base.write_text(BASE + "[train]\nsteps = 9\n")
    with pytest.raises(
        RecipeError, match=rf"^train \(steps: 1, now 9\) changed in the recipe since {tmp_path}/base was"
    ):
        run(longer, root=tmp_path)
    found = check(longer, root=tmp_path)
    assert found["train/astra/seed_0"].state == "stale" and found["ground/astra/seed_0"].is_finished
    assert found["train/astra/seed_0"].why.startswith("train (steps: 1, now 9) changed in the recipe since")
    base.write_text(BASE)
    longer.write_text(LONGER.replace("2.0", "3.0"))
    with pytest.raises(RecipeError) as caught:
        run(longer, root=tmp_path)
    assert str(caught.value) == (
        f"evaluate (rate: 2.0, now 3.0) changed in the recipe since {folder} was made: "
        f"give the recipe another name, or remove {folder / 'evaluate'}"
    )


def begun_again(folder: Path, key: str) -> Path:
    """Turn a finished artifact into the work on it of a killed run."""
    finished = folder / key
    return finished.rename(finished.with_name(f".{finished.name}.partial"))


def test_what_was_begun_with_other_settings_is_told_alike_by_check_and_run(
    base: Path, tmp_path: Path
) -> None:
    folder = run(base, root=tmp_path, jobs=2)
    for made in ("evaluate", "train/astra_plus", "train/astra/seed_1"):
        shutil.rmtree(folder / made)
    partial = begun_again(folder, "train/astra/seed_0")
    found = check(base, root=tmp_path)
    assert found["train/astra/seed_0"].state == found["train/astra/seed_1"].state == "missing"
    base.write_text(BASE + "[train]\nsteps = 9\n")
    found = check(base, root=tmp_path)
    changed = "train (steps: 1, now 9) changed in the recipe since"
    advice = f"give the recipe another name, or remove {partial}"
    assert (found["train/astra/seed_0"].state, found["train/astra/seed_1"].state) == ("stale", "missing")
    assert found["train/astra/seed_0"].why == f"{changed}: {advice}"
    with pytest.raises(RecipeError) as caught:
        run(base, root=tmp_path)
    assert str(caught.value) == f"{changed} {folder} was made: {advice}"
    shutil.rmtree(partial)
    assert check(base, root=tmp_path)["train/astra/seed_0"].state == "missing"
    run(base, root=tmp_path, jobs=2)
    assert asked(folder / "train/astra/seed_0")["steps"] == 9


def test_where_others_are_finished_what_was_begun_is_removed_with_them(base: Path, tmp_path: Path) -> None:
    folder = run(base, root=tmp_path, jobs=2)
    partial = begun_again(folder, "train/astra/seed_0")
    shutil.rmtree(folder / "evaluate")
    base.write_text(BASE + "[train]\nsteps = 9\n")
    found = check(base, root=tmp_path)
    assert found["train/astra/seed_0"].why.endswith(f"or remove {partial}")
    assert found["train/astra/seed_1"].why.endswith("or remove this")
    with pytest.raises(RecipeError, match=rf"or remove {folder / 'train'}$"):
        run(base, root=tmp_path)


def test_a_stage_that_is_borrowed_no_more_is_made_here(base: Path, longer: Path, tmp_path: Path) -> None:
    run(base, root=tmp_path, jobs=2)
    folder = run(longer, root=tmp_path, jobs=2)
    shutil.rmtree(folder / "evaluate")
    longer.write_text(LONGER + "[train]\nsteps = 9\n")
    made = attempts(tmp_path / "base")
    assert check(longer, root=tmp_path)["train/astra/seed_0"].state == "missing"
    run(longer, root=tmp_path, jobs=2)
    assert asked(folder / "train/astra/seed_0")["steps"] == 9
    assert not (folder / "train").is_symlink() and (folder / "ground").is_symlink()
    assert attempts(tmp_path / "base") == made
    longer.write_text(LONGER)
    shutil.rmtree(folder / "evaluate")
    (folder / "recipe.json").unlink()
    with pytest.raises(RecipeError) as caught:
        run(longer, root=tmp_path)
    assert str(caught.value) == (
        f"{folder / 'train'} is in the way: {longer} is based on base, whose train it uses; "
        f"give the recipe another name, or remove {folder / 'train'}"
    )


def test_a_link_that_leads_nowhere_is_in_the_way_of_what_is_borrowed(longer: Path, tmp_path: Path) -> None:
    link = tmp_path / "longer/train"
    link.parent.mkdir()
    link.symlink_to(tmp_path / "disk that is not there")
    with pytest.raises(RecipeError, match=f"^{re.escape(str(link))} is in the way: "):
        load_experiment(longer, tmp_path).link_borrowed()
    assert link.is_symlink()


def test_a_link_of_the_user_s_own_is_a_folder_like_any(base: Path, tmp_path: Path) -> None:
    collected = tmp_path / "disk/collect/seed_0"
    collected.mkdir(parents=True)
    folder = tmp_path / "base"
    folder.mkdir()
    (folder / "collect").symlink_to(collected.parent)
    experiment = load_experiment(base, tmp_path)
    assert experiment.has("collect/seed_0")
    experiment.link_borrowed()
    assert (folder / "collect").resolve() == collected.parent
    (folder / "recipe.json").write_text(experiment.recipe.model_dump_json())
    base.write_text(BASE + "[collect]\nsteps = 7\n")
    assert (
        load_experiment(base, tmp_path)
        .outdated("collect/seed_0")
        .startswith("collect (steps: 1, now 7) changed")
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('based_on = "bse"', ": based_on: unknown recipe 'bse': did you mean 'base'?"),
        ("based_on = 3", ": based_on: unknown recipe '3'; known: base"),
        ('based_on = "longer"', ": based_on: unknown recipe 'longer'; known: base"),
        ('based_on = "base"\ntask = "moon"', ": task: unknown task 'moon'; known: " + KNOWN),
        (
            'based_on = "base"\nmethods = ["nas", "astra"]\nseeds = [0, 5]',
            " does not fit what it is based on: methods: base has no 'nas', it has ['astra', 'astra_plus', "
            "'follower']: {0}; seeds: base has no '5', it has [0, 1]: {0}",
        ),
        ('based_on = "base"\nevaluate = 3', ": evaluate: expected a table, got 3"),
        (LONGER + "step = 3", ": evaluate.step: unknown key: did you mean 'steps'?"),
    ],
)
def test_faults_are_told(longer: Path, text: str, expected: str) -> None:
    longer.write_text(text)
    with pytest.raises(RecipeError) as caught:
        load_experiment(longer, longer.parent)
    advice = f"add it to those of {longer.with_name('base.toml')} and run that, or leave out based_on"
    assert str(caught.value) == f"{longer}{expected.replace('{0}', advice)}"


def test_there_is_no_chain(longer: Path) -> None:
    third = longer.with_name("third.toml")
    third.write_text('based_on = "longer"')
    with pytest.raises(RecipeError, match=r"expected a recipe that is not based on another, got 'longer'$"):
        load_experiment(third, longer.parent)


def test_a_table_that_the_folder_s_recipe_did_not_have_is_no_change(base: Path, tmp_path: Path) -> None:
    folder = run(base, root=tmp_path, jobs=2)
    record = folder / "recipe.json"
    kept = json.loads(record.read_text())
    del kept["target"]
    record.write_text(json.dumps(kept))
    assert check(base, root=tmp_path)["train/astra/seed_0"].is_finished
    kept["collect"].pop("episodes")
    record.write_text(json.dumps(kept))
    assert check(base, root=tmp_path)["train/astra/seed_0"].is_finished
    kept = load_experiment(base, tmp_path).recipe.settings
    record.write_text(json.dumps(kept | {"gone": {"rate": 1.0}}))
    assert check(base, root=tmp_path)["train/astra/seed_0"].is_finished
    base.write_text(BASE + "[report]\nsteps = 9\n")
    assert check(base, root=tmp_path)["report"].is_finished, "every run makes it"
    record.write_text(json.dumps(kept | {"task": "moon"}))
    assert check(base, root=tmp_path)["train/astra/seed_0"].why.startswith(
        'report (steps: 1, now 9) and task ("moon", now "maze") changed'
    )


def test_the_settings_of_a_method_reach_the_rows_that_read_them(base: Path, tmp_path: Path) -> None:
    base.write_text(BASE.replace('"follower"', '"full_obs"'))
    folder = run(base, root=tmp_path, jobs=2)
    base.write_text(base.read_text() + "[target]\nnum_envs = 3\n")
    with pytest.raises(RecipeError) as caught:
        run(base, root=tmp_path)
    stale = f"{folder / 'evaluate/full_obs'} {folder / 'train/full_obs'}"
    assert str(caught.value).endswith(f"or remove {stale}")
    base.write_text(BASE + "[target]\nnum_envs = 3\n[iql]\ndiscount = 0.9\n")
    for stage in ("train", "evaluate"):
        shutil.rmtree(folder / stage / "full_obs")
    assert check(base, root=tmp_path)["train/astra/seed_0"].is_finished


@pytest.mark.parametrize(
    ("rows", "table", "stale"),
    [
        ([], "ground", ["align", "evaluate/astra", "evaluate/astra_plus", "ground", "train/astra"]),
        (["nas"], "ground", ["align", "evaluate", "ground", "train/astra"]),
        ([], "align", ["align", "evaluate/astra", "evaluate/astra_plus"]),
    ],
)
def test_rows_that_ground_or_align_nothing_are_left_alone(
    rows: list[str], table: str, stale: list[str], base: Path, tmp_path: Path
) -> None:
    if "train/astra" in stale:
        stale = [*stale, "train/astra_plus", *(f"train/{row}" for row in rows)]
    methods = ["direct_transfer", "fine_tuned", "follower", "target", "astra", "astra_plus", *rows]
    text = f'task = "maze"\nmethods = {json.dumps(methods)}\nseeds = [0]\n'
    base.write_text(text)
    folder = run(base, root=tmp_path, jobs=2)
    base.write_text(f"{text}[{table}]\nrate = 2.0\n")
    conditions = check(base, root=tmp_path)
    with pytest.raises(RecipeError) as caught:
        run(base, root=tmp_path)
    places = [folder / place for place in stale]
    assert str(caught.value).endswith(f"or remove {' '.join(map(str, places))}")
    others = [key for key in conditions if not any((folder / key).is_relative_to(one) for one in places)]
    assert {key for key, found in conditions.items() if found.is_finished} == set(others)
    made = {key: attempts(folder / key) for key in others}
    for place in places:
        shutil.rmtree(place)
    run(base, root=tmp_path, jobs=2)
    assert made | {"report": 1} == {key: attempts(folder / key) for key in others}
    assert all(found.is_finished for found in check(base, root=tmp_path).values())


def test_what_was_tested_in_the_reference_depends_on_its_grounding_once_it_is_no_row(
    base: Path, tmp_path: Path
) -> None:
    text = BASE.replace('"follower"', '"follower", "nas"')
    base.write_text(text)
    folder = run(base, root=tmp_path, jobs=2)
    base.write_text(BASE)
    run(base, root=tmp_path, jobs=2)
    base.write_text(BASE + "[ground]\nrate = 2.0\n")
    with pytest.raises(RecipeError, match=f"{folder}/evaluate "):
        run(base, root=tmp_path)


def test_a_choice_depends_on_all_groundings(base: Path, tmp_path: Path) -> None:
    text = 'task = "maze"\nmethods = ["nas", "direct_transfer"]\nseeds = [0, 1]\n[select]\n'
    base.write_text(text)
    folder = run(base, root=tmp_path, jobs=2)
    base.write_text(text + "[ground]\nrate = 2.0\n")
    with pytest.raises(RecipeError, match=f"{folder}/ground {folder}/select {folder}/train/nas$"):
        run(base, root=tmp_path)


def test_recipes_are_read_without_what_only_trainings_and_tables_need() -> None:
    code = (
        "import sys, astra_data.pipeline.run; "
        "assert not {'pandas', 'matplotlib', 'gymnasium'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_stage_that_no_row_has_is_told(base: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"^the recipe has no stage 'subset'$"):
        run_stage(base, "subset", root=tmp_path)
