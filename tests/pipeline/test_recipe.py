import json
import re
from pathlib import Path
from typing import Any

import pytest

from astra_data.core.config import validated
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.methods.iql import IqlConfig
from astra_data.pipeline.recipe import Recipe, read_tables, recorded_settings
from astra_data.policies.train import PpoTrainConfig, SacTrainConfig, TargetConfig

BASE = {"task": "humanoid-walker2d", "methods": ["direct_transfer"], "seeds": [0]}
SAC = {"learner": "sac"}


def read(**tables: Any) -> Recipe:
    return validated(BASE | tables, Recipe, "r.toml")


def test_the_learner_decides_what_the_training_is_told() -> None:
    assert isinstance(read().train, PpoTrainConfig)
    recipe = read(train=SAC | {"window": 24})
    assert isinstance(recipe.train, SacTrainConfig) and recipe.train.window == 24
    assert read(**recipe.settings) == recipe


def test_settings_are_those_of_the_rows_method_for_the_stage_that_takes_them() -> None:
    rows = ["iql", "behavior_cloning", "direct_transfer_iql", "target", "full_obs", "astra"]
    recipe = read(methods=rows, iql={"batch_windows": 5}, target={"num_envs": 3})
    assert recipe.settings_of("iql", "train") == IqlConfig(batch_windows=5)
    assert recipe.settings_of("behavior_cloning", "train") == IqlConfig(batch_windows=5)
    assert recipe.settings_of("direct_transfer_iql", "train") == IqlConfig(batch_windows=5)
    assert recipe.settings_of("full_obs", "train") == TargetConfig(num_envs=3)
    assert recipe.settings_of("target", "ground") is recipe.settings_of("astra", "train") is None


def test_alignment_holds_out_what_grounding_does() -> None:
    assert read().align.held_out_share == read().ground.held_out_share
    assert read(ground={"held_out_share": 0.3}).align.held_out_share == 0.3
    both = {"held_out_share": 0.25}
    assert read(ground=both, align=both | {"updates": 7}).align.updates == 7
    message = r"align: held_out_share: expected that of \[ground\], 0.3, got 0.1"
    with pytest.raises(RecipeError, match=message):
        read(ground={"held_out_share": 0.3}, align={"held_out_share": 0.1})


def test_stages_get_their_tables() -> None:
    recipe = read(train={"num_envs": 8}, collect={"episodes": 40}, sweep={"percent": [50]})
    assert recipe.config_of("train").num_envs == 8  # type: ignore[union-attr]
    assert recipe.config_of("evaluate") == recipe.evaluate
    # What is collected is the largest size.
    assert recipe.config_of("collect").episodes == 20  # type: ignore[union-attr]
    assert recipe.config_of("subset") is None
    assert recipe.select is None, "a choice is made where a recipe asks for one"


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"train": {"learner": "foo"}}, "train.learner: expected 'ppo' or 'sac', got 'foo'"),
        ({"train": {"burn_in": 4}}, "train.burn_in: unknown key: 'sac' has it, not 'ppo'"),
        ({"train": SAC | {"num_env": 9}}, "train.num_env: unknown key: did you mean 'num_envs'?"),
        ({"train": SAC, "methods": ["rma"]}, "methods: rma: expected train.learner 'ppo', got 'sac'"),
        ({"plus": {}}, "plus: unknown key"),
        ({"methods": ["iql_plus"]}, "'iql_plus' trains nothing in a simulator"),
        ({"train": 3}, "train: expected a table, got 3"),
        ({"train": {"memory_size": -1}}, "train.memory_size: expected greater than or equal to 0"),
        ({"collect": {"hold_s": [3.0, 0.5]}}, "collect.hold_s: expected the lower end first, got [3.0, 0.5]"),
        ({"collect": {"episodes": 10**10}}, "collect: episodes: 10000000000 of up to 500"),
        (
            {"sweep": {"percent": [50], "ground.latent_weight": [0, 1]}},
            "sweep: expected percent alone, got ground.latent_weight: for values of another setting",
        ),
        ({"sweep": {"percent": [10**9]}}, "sweep.percent.0: expected less than or equal to 10000"),
        (
            {"task": "antmaze-umaze", "sweep": {"percent": [50]}, "augment": {}},
            "sweep.percent: counts recorded episodes, but [augment] adds copies",
        ),
        (
            {"sweep": {"percent": [50]}, "collect": {"least_steps": 9}},
            "sweep.percent: counts recorded episodes, but collect.least_steps may record fewer: leave out",
        ),
        ({"train": {"hidden_sizes": [10**9]}}, "train.hidden_sizes.0: expected less than or equal to"),
        ({"task": "antmaze-umaze", "collect": {"behavior": "suboptimal_sac"}}, "use 'suboptimal_ppo'"),
    ],
)
def test_what_does_not_fit_the_learner_is_told_in_a_line(tables: dict[str, Any], message: str) -> None:
    with pytest.raises(RecipeError, match=f"^r.toml: .*{re.escape(message)}") as caught:
        read(**tables)
    assert "\n" not in str(caught.value)


def test_a_method_of_ones_own_that_is_not_there_is_told_once() -> None:
    with pytest.raises(RecipeError, match=r"user_methods: .*nothing\.py") as caught:
        read(user_methods={"mine": "nothing.py:METHOD"}, methods=["mine"])
    assert "unknown method" not in str(caught.value)


@pytest.mark.parametrize("seed", [-1, 2**63, 2**64])
def test_seeds_are_those_that_every_stage_takes(seed: int) -> None:
    assert read(seeds=[0, 2**63 - 1]).seeds[1] == 2**63 - 1
    for seeds in ([0, seed], [seed]):
        with pytest.raises(RecipeError, match=rf"seeds\.{len(seeds) - 1}: ") as told:
            read(seeds=seeds)
        assert "or more, got none" not in str(told.value)


def test_a_run_or_a_dataset_in_place_of_a_recipe_is_told(tmp_path: Path) -> None:
    run, pairs, other = tmp_path / "mec", tmp_path / "mec/pair/seed_0", tmp_path / "walks"
    for dataset in (pairs, other):
        (dataset / "meta").mkdir(parents=True)
        (dataset / "meta/info.json").touch()
    (run / "recipe.json").touch()
    for path, told in (
        (run, "a run: expected the recipe that made it, mec.toml"),
        (pairs, "a dataset: expected the recipe that made it, mec.toml"),
        (other, "a dataset: expected the recipe that made it"),
        (tmp_path, "a folder: expected a TOML file"),
    ):
        with pytest.raises(RecipeError, match=f"^{path} is {told}$"):
            read_tables(path)
    with pytest.raises(RecipeError, match="cannot be read as a text file"):
        read_tables(tmp_path / ("n" * 300))


def test_a_mapping_in_place_of_a_recipe_is_told() -> None:
    path = Path(__file__).parents[2] / "recipes/imports/nao_guda.toml"
    with pytest.raises(RecipeError) as caught:
        read_tables(path)
    assert str(caught.value) == f"{path} is a mapping: `astra-data import LOGS --mapping {path}`"


def test_what_a_run_recorded_is_read_with_keys_of_any_age(tmp_path: Path) -> None:
    recorded = {"task": "a", "user_methods": {"mine": {"method": "m.py:M", "rate": 0.5}}, "gone": [1, None]}
    (tmp_path / "recipe.json").write_text(json.dumps(recorded))
    assert recorded_settings(tmp_path) == recorded


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "file: Invalid JSON"),
        ("[]", "file: "),
        ("{}", "task: Field required"),
        ('{"task": "a", "sweep": []}', "sweep: "),
        ('{"task": "a", "user_methods": {"mine": {}}}', "user_methods.mine.method: Field required"),
    ],
)
def test_a_damaged_record_is_told(text: str, fault: str, tmp_path: Path) -> None:
    (tmp_path / "recipe.json").write_text(text)
    with pytest.raises(BadInputError) as caught:
        recorded_settings(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path}/recipe.json is not what a run writes: {fault}")
    assert str(caught.value).endswith("or move the folder away and run the recipe again")
    assert "\n" not in str(caught.value)
