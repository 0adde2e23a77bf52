"""Recipes that are based on others."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from fake_runs import results
from fake_stages import FakeStages

from astra_data.core.errors import BadInputError, MissingStageError, RecipeError
from astra_data.pipeline.experiment import load_experiment
from astra_data.pipeline.run import check, run, run_stage
from astra_data.reports.results import results_json
from astra_data.robots.registry import TASKS

BASE = 'task = "antmaze-umaze"\nmethods = ["astra", "astra_plus", "follower"]\nseeds = [0, 1]\n'
LONGER = 'based_on = "base"\n[evaluate]\nepisodes = 3\n'
pytestmark = pytest.mark.usefixtures("stages")


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


def borrowed(base: Path, text: str) -> set[str]:
    path = base.with_name("other.toml")
    path.write_text(f'based_on = "base"\n{text}')
    return load_experiment(path, base.parent).borrowed


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "collect pair ground train align evaluate"),
        ("seeds = [1]\nmethods = ['follower']\n[report]\ntrajectory_episodes = 2\n", "collect pair evaluate"),
        ("[evaluate]\nepisodes = 2\n", "collect pair ground train align"),
        ("[train]\ntries = 3\n", "collect pair ground align"),
        ("[align]\nupdates = 2\n", "collect pair ground train"),
        ("[ground]\nupdates = 2\n", "collect pair"),
        ("[collect]\nepisodes = 2\n", ""),
        ("[target]\nnum_envs = 3\n", "collect pair ground train align evaluate"),
        ("[augment]\n", "collect"),
    ],
)
def test_what_differs_and_what_reads_it_is_made_anew(base: Path, text: str, expected: str) -> None:
    assert borrowed(base, text) == {*expected.split()}


@pytest.mark.parametrize(
    ("theirs", "ours", "expected"),
    [
        ("", "[25, 100]", "collect pair"),
        ("[25, 100]", "[25, 50, 100]", "collect pair"),
        ("[25, 100]", "[100]", "collect pair subset ground train align evaluate"),
        ("[25, 100]", "[]", "collect pair"),
    ],
)
def test_sizes_that_the_base_has_not_are_made_of_its_pairs(base: Path, theirs: str, ours: str, expected: str) -> None:
    base.write_text(BASE + (f"[sweep]\npercent = {theirs}\n" if theirs else ""))
    assert borrowed(base, f"[sweep]\npercent = {ours}\n") == {*expected.split()}


def test_data_replace_what_the_base_collects_and_the_other_way_around(base: Path) -> None:
    collects, given = "[collect]\nepisodes = 7\n", 'data = "me/walks"\n'
    for theirs, ours in ((BASE + collects, given), (given + BASE, collects)):
        base.write_text(theirs)
        assert borrowed(base, ours) == set()
        found = load_experiment(base.with_name("other.toml"), base.parent).recipe
        assert (found.data is None) == (found.collect is not None) == (ours == collects)
        with pytest.raises(RecipeError, match=r"data replaces \[collect\]: leave out one of them$"):
            borrowed(base, f"{given}{collects}")


def test_a_task_of_the_same_target_shares_the_episodes(
    base: Path, tmp_path: Path, stages: FakeStages, monkeypatch: pytest.MonkeyPatch
) -> None:
    def with_targets(*targets: str | None) -> str:
        for name, target in zip(("antmaze-umaze", "sketch"), targets, strict=True):
            monkeypatch.setitem(TASKS, name, replace(TASKS["antmaze-umaze"], name=name, target_id=target))
        return 'task = "sketch"\nmethods = ["follower"]\nseeds = [1]\n'

    for others in ((None, None), ("ant", "other ant")):
        with pytest.raises(RecipeError, match=r"'antmaze-umaze', or one with the same target, got 'sketch'$"):
            borrowed(base, with_targets(*others))
    assert borrowed(base, with_targets("ant", "ant")) == {"collect"}
    path = base.with_name("other.toml")
    command = f"astra-data collect {base} --root {tmp_path}"
    with pytest.raises(MissingStageError, match=f"run `{re.escape(command)}` first"):
        run(path, root=tmp_path)
    run_stage(base, "collect", root=tmp_path)
    folder = run(path, root=tmp_path)
    assert stages.asked["pair/seed_1"]["simulator"] == "sketch"
    assert stages.asked["pair/seed_1"]["dataset"] == folder / "collect/seed_1"


def test_a_run_reads_what_the_base_made_and_makes_only_the_rest(
    base: Path, longer: Path, tmp_path: Path, stages: FakeStages
) -> None:
    missing = f"{tmp_path / 'base/train/astra/seed_0'} is missing: run `astra-data run {base} --root {tmp_path}`"
    with pytest.raises(MissingStageError, match=re.escape(missing)):
        run(longer, root=tmp_path)
    with pytest.raises(MissingStageError, match=re.escape(missing)):
        run_stage(longer, "evaluate", root=tmp_path)
    with pytest.raises(BadInputError, match=f"uses the train of {base}: run `astra-data train {base}` instead"):
        run_stage(longer, "train", root=tmp_path)
    run(base, root=tmp_path)
    stages.made.clear()
    folder = run(longer, root=tmp_path)
    assert {key.partition("/")[0] for key in stages.made} == {"evaluate", "report"}
    links = {path.name for path in folder.iterdir() if path.is_symlink()}
    assert links == {"collect", "pair", "ground", "train", "align"}
    policy = stages.asked["evaluate/astra_plus/seed_1"]["policy"]
    assert policy == folder / "train/astra_plus/seed_1" and policy.is_dir()
    assert all(found.state == "finished" for found in check(longer, root=tmp_path).values())
    for name in ("base", "longer"):  # links and all, the runs may be moved
        shutil.move(tmp_path / name, tmp_path / f"moved/{name}")
    assert (tmp_path / "moved/longer/train/astra/seed_0").is_dir()


def test_changes_are_told_in_the_base_and_here(base: Path, longer: Path, tmp_path: Path) -> None:
    run(base, root=tmp_path)
    folder = run(longer, root=tmp_path)
    base.write_text(BASE + "[train]\ntries = 9\n")
    told = rf"^train \(tries: \d, now 9\) changed in the recipe since {tmp_path}/base was"
    with pytest.raises(RecipeError, match=told):
        run(longer, root=tmp_path)
    found = check(longer, root=tmp_path)
    assert found["train/astra/seed_0"].state == "stale" and found["ground/astra/seed_0"].state == "finished"
    base.write_text(BASE)
    longer.write_text(LONGER.replace("3", "4"))
    with pytest.raises(RecipeError, match=rf"now 4\) changed .* since {folder} was made: .* remove {folder}/ev"):
        run(longer, root=tmp_path)


def test_a_stage_that_is_borrowed_no_more_is_made_here_and_then_in_the_way(
    base: Path, longer: Path, tmp_path: Path, stages: FakeStages
) -> None:
    run(base, root=tmp_path)
    folder = run(longer, root=tmp_path)
    shutil.rmtree(folder / "evaluate")
    longer.write_text(LONGER + "[train]\ntries = 9\n")
    run(longer, root=tmp_path)
    assert not (folder / "train").is_symlink() and (folder / "ground").is_symlink()
    assert stages.asked["train/astra/seed_0"]["config"].tries == 9
    longer.write_text(LONGER)
    shutil.rmtree(folder / "evaluate")
    with pytest.raises(RecipeError, match=rf"^{folder}/train is in the way: {longer} is based on base, whose"):
        run(longer, root=tmp_path)


def test_a_link_of_the_user_s_is_a_folder_like_any(base: Path, longer: Path, tmp_path: Path) -> None:
    link = tmp_path / "longer/train"
    link.parent.mkdir()
    link.symlink_to(tmp_path / "disk that is not there")
    with pytest.raises(RecipeError, match=f"^{re.escape(str(link))} is in the way: "):
        load_experiment(longer, tmp_path).link_borrowed()
    assert link.is_symlink()
    collected = tmp_path / "disk/collect/seed_0"
    collected.mkdir(parents=True)
    (tmp_path / "base").mkdir()
    (tmp_path / "base/collect").symlink_to(collected.parent)
    experiment = load_experiment(base, tmp_path)
    experiment.link_borrowed()
    assert experiment.has("collect/seed_0") and (tmp_path / "base/collect").resolve() == collected.parent


def test_the_base_has_published_what_is_borrowed_of_it(base: Path, longer: Path) -> None:
    part = base.with_name("part.toml")
    part.write_text('based_on = "base"\nmethods = ["astra"]\n')
    settings = load_experiment(base, base.parent).recipe.settings
    for name in ("base", "part"):
        (base.parent / f"results/{name}").mkdir(parents=True)
        (base.parent / f"results/{name}/results.json").write_text(results_json(results(settings=settings)))
    for path, expected in ((base, ["base"]), (longer, []), (part, ["base", "part"])):
        found = load_experiment(path, base.parent).published()
        assert found == [base.parent / f"results/{name}/results.json" for name in expected]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('based_on = "bse"', "based_on: unknown recipe 'bse': did you mean 'base'?"),
        ('based_on = "longer"', "based_on: unknown recipe 'longer'; known: base"),
        (
            'based_on = "base"\nmethods = ["nas"]\nseeds = [0, 5]',
            "methods: base has no 'nas', it has ['astra', 'astra_plus', 'follower']: add it to those of",
        ),
        ('based_on = "base"\nevaluate = 3', "evaluate: expected a table, got 3"),
    ],
)
def test_faults_are_told(longer: Path, text: str, expected: str) -> None:
    longer.write_text(text)
    with pytest.raises(RecipeError, match=re.escape(expected)):
        load_experiment(longer, longer.parent)


def test_one_seed_inherits_no_choice_among_seeds(base: Path) -> None:
    base.write_text(f"{base.read_text()}\n[select]\n")
    other = base.with_name("other.toml")
    for seeds, has_choice in (("[1]", False), ("[1, 0]", True)):
        other.write_text(f'based_on = "base"\nseeds = {seeds}\n')
        assert (load_experiment(other, base.parent).recipe.select is not None) == has_choice


def test_there_is_no_chain(longer: Path) -> None:
    longer.with_name("third.toml").write_text('based_on = "longer"')
    with pytest.raises(RecipeError, match=r"expected a recipe that is not based on another, got 'longer'$"):
        load_experiment(longer.with_name("third.toml"), longer.parent)
