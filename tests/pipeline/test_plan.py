import inspect
from functools import partial
from pathlib import Path

import pytest

from astra_data.core.config import load_recipe
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.pipeline.plan import ARTIFACTS, plan, selected, stages_until
from astra_data.pipeline.recipe import Recipe
from astra_data.pipeline.stages.registry import STAGES

ROWS = '"follower", "direct_transfer", "astra", "astra_plus"'
HEAD = f'task = "antmaze-umaze"\nmethods = [{ROWS}]\nseeds = [0, 7]\n'


def load(folder: Path, text: str) -> Recipe:
    path = folder / "r.toml"
    path.write_text(text)
    return load_recipe(path, Recipe)


def test_rows_read_what_their_method_needs(tmp_path: Path) -> None:
    recipe = load(tmp_path, HEAD)
    items = {item.key: item for item in plan(recipe, tmp_path / "r.toml", tmp_path)}
    assert len(items) == 2 * (1 + 1 + 1 + 3 + 1 + 4) + 1 and items["ground/astra/seed_7"].inputs == ("pair/seed_7",)
    assert items["train/direct_transfer/seed_0"].inputs == ("pair/seed_0",)
    assert items["train/astra_plus/seed_0"].inputs == ("pair/seed_0", "ground/astra/seed_0")
    assert items["evaluate/follower/seed_0"].inputs == ()
    assert items["evaluate/astra_plus/seed_0"].inputs == (
        "train/astra_plus/seed_0",
        "ground/astra/seed_0",
        "align/astra/seed_0",
    )
    assert len(items["report"].inputs) == 8
    calls = {row: items[f"evaluate/{row}/seed_7"].call for row in ("astra_plus", "direct_transfer", "follower")}
    recorded = {row: call.keywords["recorded"] for row, call in calls.items() if isinstance(call, partial)}
    pairs = tmp_path / "pair/seed_7"
    assert recorded == {"astra_plus": pairs, "direct_transfer": pairs, "follower": None}


def test_rows_are_tested_in_one_grounded_simulator_if_the_recipe_has_it(tmp_path: Path) -> None:
    text = HEAD.replace('"astra_plus"', '"nas_plus"')
    items = {item.key: item for item in plan(load(tmp_path, text), tmp_path / "r.toml", tmp_path)}
    assert items["evaluate/follower/seed_7"].inputs == ("ground/nas/seed_7",)
    assert items["evaluate/nas_plus/seed_7"].inputs == ("train/nas_plus/seed_7", "ground/nas/seed_7")
    assert items["evaluate/astra/seed_7"].inputs[-1] == "ground/nas/seed_7"


def test_a_recipe_may_augment_what_it_collects(tmp_path: Path) -> None:
    recipe = load(tmp_path, HEAD + "[collect]\nepisodes = 50\n[augment]\nepisodes = 90\n")
    items = {item.key: item for item in plan(recipe, tmp_path / "r.toml", tmp_path)}
    assert items["augment/seed_7"].inputs == ("collect/seed_7",)
    assert items["pair/seed_7"].inputs == ("augment/seed_7",)
    call = items["augment/seed_7"].call
    assert isinstance(call, partial) and call.keywords["seed"] == 7
    assert call.keywords["dataset"] == tmp_path / "collect/seed_7"
    plain = plan(load(tmp_path, HEAD), tmp_path / "r.toml", tmp_path)
    assert not [item for item in plain if item.key.startswith("augment")]


def test_rows_are_made_of_every_size(tmp_path: Path) -> None:
    recipe = load(tmp_path, HEAD + "[sweep]\npercent = [50, 150]\n")
    items = {item.key: item for item in plan(recipe, tmp_path / "r.toml", tmp_path)}
    assert len(items) == 2 * (1 + 1 + 2 * (1 + 1 + 3 + 1 + 4)) + 1
    assert items["collect/seed_7"].call.keywords["config"].episodes == 300  # type: ignore[attr-defined]
    assert items["subset/percent_050/seed_7"].inputs == ("pair/seed_7",)
    assert items["ground/astra/percent_150/seed_0"].inputs == ("subset/percent_150/seed_0",)
    assert items["evaluate/astra_plus/percent_050/seed_0"].inputs == (
        "train/astra_plus/percent_050/seed_0",
        "ground/astra/percent_050/seed_0",
        "align/astra/percent_050/seed_0",
    )
    report = items["report"].call
    assert report.args[0].percents == (50, 150)  # type: ignore[attr-defined]
    assert report.keywords["command"] == f"astra-data run {tmp_path / 'r.toml'}"  # type: ignore[attr-defined]


def test_a_part_of_a_sweep_collects_as_much_as_the_whole(tmp_path: Path) -> None:
    recipe = load(tmp_path, HEAD + "[sweep]\npercent = [50, 150]\n")
    part = selected(recipe, methods=["astra"], seeds=[7], percents=[50])
    items = {item.key: item for item in plan(recipe, tmp_path / "r.toml", tmp_path, part, reports=part)}
    assert list(items) == [
        "collect/seed_7",
        "pair/seed_7",
        "subset/percent_050/seed_7",
        "ground/astra/percent_050/seed_7",
        "train/astra/percent_050/seed_7",
        "align/astra/percent_050/seed_7",
        "evaluate/astra/percent_050/seed_7",
        "report",
    ]
    assert items["collect/seed_7"].call.keywords["config"].episodes == 300  # type: ignore[attr-defined]
    options = "--method astra --seed 7 --percent 50"
    assert items["report"].call.keywords["command"].endswith(f"r.toml {options}")  # type: ignore[attr-defined]
    *_, report = plan(recipe, tmp_path / "r.toml", tmp_path, part)
    assert report.call.args[0].methods == recipe.methods  # type: ignore[attr-defined]


def test_who_steps_the_target_gets_threads_and_networks_a_device(tmp_path: Path) -> None:
    text = HEAD.replace('"astra_plus"', '"target"')
    recipe = load(tmp_path, text)
    items = plan(recipe, tmp_path / "r.toml", tmp_path, device="cuda")
    threaded = {item.key.removesuffix("/seed_0") for item in items if item.is_threaded and "seed_0" in item.key}
    rows = ("follower", "direct_transfer", "astra", "target")
    assert threaded == {"collect", "train/target", *(f"evaluate/{row}" for row in rows)}
    assert {item.stage for item in items if item.device == "cuda"} == {"ground", "train", "align"}
    settings = {item.key: item.call.keywords.get("settings") for item in items}  # type: ignore[attr-defined]
    assert settings["train/target/seed_0"] is not None and settings["train/astra/seed_0"] is None
    recorded = {item.key: item.call.keywords.get("recorded") for item in items}  # type: ignore[attr-defined]
    assert recorded["evaluate/target/seed_0"] is None and recorded["evaluate/astra/seed_0"] == tmp_path / "pair/seed_0"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (HEAD.replace("7", "0"), "expected each of seeds once, got [0, 0]"),
        (HEAD.replace('"follower"', '"astra"'), "expected each of methods once, got ['astra', 'direct_tra"),
        (HEAD + "[sweep]\npercent = [5, 5]", "expected each of sweep.percent once, got [5, 5]"),
        (
            HEAD + "[collect]\nepisodes = 9\n[sweep]\npercent = [5]",
            "sweep.percent: 5 % of 9 episodes are none: expected more",
        ),
        (HEAD.replace("[0, 7]", "[]"), "seeds: expected 1 or more, got none"),
    ],
)
def test_faults_are_told(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(RecipeError) as caught:
        load(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'r.toml'}: {expected}")


def test_a_recipe_with_data_labels_that_and_collects_nothing(tmp_path: Path) -> None:
    text = 'data = "walks@data-1.0.0"\n' + HEAD + "[sweep]\npercent = [50, 100]\n"
    recipe = load(tmp_path, text)
    items = {item.key: item for item in plan(recipe, tmp_path / "r.toml", tmp_path)}
    assert not [key for key in items if key.startswith("collect")]
    label, subset = (items[key].call.keywords for key in ("label/seed_7", "subset/percent_050/seed_7"))  # type: ignore[attr-defined]
    assert (label["data"], label["seed"], label["out"]) == ("walks@data-1.0.0", 7, tmp_path / "label/seed_7")
    assert items["pair/seed_7"].inputs == ("label/seed_7",)
    without = load(tmp_path, HEAD)
    assert subset["of"] is None
    reported = plan(without, tmp_path / "r.toml", tmp_path)[-1].call.args[0]  # type: ignore[attr-defined]
    assert reported.settings["data"] is None
    with pytest.raises(RecipeError, match=r"sweep\.percent: expected at most 100 % of data, got 150"):
        load(tmp_path, 'data = "walks"\n' + HEAD + "[sweep]\npercent = [150]\n")


SELECT = HEAD.replace('"astra_plus"', '"astra_plus", "target", "nas"') + "[select]\nepisodes = 3\n"


def test_a_choice_reads_all_policies_and_groundings_that_it_needs(tmp_path: Path) -> None:
    recipe = load(tmp_path, SELECT)
    planned = plan(recipe, tmp_path / "r.toml", tmp_path)
    items = {item.key: item for item in planned}
    rows, seeds = ("direct_transfer", "astra", "astra_plus", "nas"), (0, 7)
    policies = {f"train/{row}/seed_{seed}" for row in rows for seed in seeds}  # neither follower nor target
    groundings = {f"ground/{owner}/seed_{seed}" for owner in ("astra", "nas") for seed in seeds}
    assert set(items["select"].inputs) == policies | groundings
    assert [item.key for item in planned][-2:] == ["select", "report"] and items["report"].inputs[-1] == "select"
    call = items["select"].call
    assert isinstance(call, partial) and call.keywords == {"root": tmp_path}
    assert call.args[0].methods == recipe.methods and call.args[1].episodes == 3
    assert "select" not in {item.key for item in plan(load(tmp_path, HEAD), tmp_path, tmp_path)}


def test_rows_without_policies_to_judge_are_reported_without_a_choice(tmp_path: Path) -> None:
    recipe = load(tmp_path, SELECT)
    for part in (
        selected(recipe, methods=["follower"]),
        selected(recipe, methods=["target"]),
        selected(recipe, seeds=[7]),  # one seed alone is not judged
    ):
        items = {item.key: item for item in plan(recipe, tmp_path / "r.toml", tmp_path, part)}
        assert "select" not in items and "select" not in items["report"].inputs


def test_the_judge_is_grounded_even_if_its_row_is_left_out(tmp_path: Path) -> None:
    recipe = load(tmp_path, SELECT.replace("episodes = 3", 'judge = "astra_plus"'))
    part = selected(recipe, methods=["direct_transfer"])
    items = {item.key: item for item in plan(recipe, tmp_path / "r.toml", tmp_path, part)}
    assert "ground/astra/seed_7" in items and "ground/astra/seed_7" in items["select"].inputs
    assert "ground/nas/seed_7" not in items["select"].inputs


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            SELECT.replace("[0, 7]", "[0]"),
            "select: expected two seeds or more, got 1 .judges are of other seeds.: remove .select., or add",
        ),
        (
            SELECT + 'judge = "target"\n',
            "expected a row that grounds its simulator, such as nas or astra, as judge, got target",
        ),
        (SELECT + 'judge = "nash"\n', "nash"),
        (
            HEAD.replace('"direct_transfer", "astra", "astra_plus"', '"target"') + '[select]\njudge = "nas"\n',
            "select: expected a row with policies of abstract states, got none",
        ),
    ],
)
def test_a_choice_that_cannot_be_made_is_refused(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=message):
        load(tmp_path, text)


def test_the_last_stage_is_one_of_those_made() -> None:
    assert stages_until("collect") == {"collect"}
    assert stages_until("subset") == {"collect", "label", "augment", "pair", "subset"}
    assert stages_until(None) - stages_until("select") == {"evaluate", "report"}
    with pytest.raises(BadInputError, match=r"unknown stage 'grond'.*ground"):
        stages_until("grond")


def test_a_stage_is_named_as_the_function_that_makes_it() -> None:
    for name, stage in STAGES.items():
        assert stage.name == name == stage.run.__name__
        assert stage.run.__module__ == f"astra_data.pipeline.stages.{name}"


def test_a_stage_asks_for_nothing_that_the_plan_does_not_know() -> None:
    known = {"task", "simulator", "method", "config", "settings", "seed", "percent", "of", "out", "device"}
    known |= {"data"}
    for stage in STAGES.values():
        if stage.each == "recipe":
            continue
        parameters = inspect.signature(stage.run).parameters.values()
        needed = {parameter.name for parameter in parameters if parameter.default is parameter.empty}
        assert needed <= known | set(ARTIFACTS) | {"progress"}, stage.name
        assert ("config" in {parameter.name for parameter in parameters}) == (stage.config is not None)
