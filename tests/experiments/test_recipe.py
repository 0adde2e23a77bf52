import re
from typing import Any

import pytest

from astra_data.core.config import Config, validated
from astra_data.core.errors import RecipeError
from astra_data.experiments.recipe import Recipe, with_tables
from astra_data.learning.iql import FINE_TUNING, IqlConfig
from astra_data.methods.method import Table
from astra_data.stages.registry import STAGES
from astra_data.training.train import PpoTrainConfig, SacTrainConfig
from astra_data.training.train_in_target import TargetConfig

BASE = {
    "task": "humanoid-walker2d",
    "methods": ["direct_transfer"],
    "seeds": [0],
    "collect": {"start": "task"},
}
SAC = {"learner": "sac"}


def read(**tables: Any) -> Recipe:  # noqa: ANN401
    return validated(BASE | tables, Recipe, "r.toml")


def test_the_learner_decides_what_the_training_is_told() -> None:
    assert isinstance(read().train, PpoTrainConfig)
    recipe = read(train=SAC | {"window": 16}, plus={"window": 24})
    assert isinstance(recipe.train, SacTrainConfig) and isinstance(recipe.plus, SacTrainConfig)
    assert (recipe.train.window, recipe.plus.window) == (16, 24)
    assert read(**recipe.settings) == recipe


def test_a_limit_of_commands_that_does_not_reach_all_rows_is_refused() -> None:
    limit = {"command_limit": 1.0}
    tables: dict[str, Any] = {"task": "antmaze-umaze", "methods": ["astra", "iql", "target", "follower"]}
    assert not read(**tables, plus=limit).train.limits_commands
    with pytest.raises(RecipeError, match="has no effect on iql, target, which no simulator trains"):
        read(**tables, train=limit)


def test_rows_that_predict_no_reward_are_not_trained_with_it() -> None:
    predicted, rows = {"reward": "predicted"}, ["astra", "iql", "target", "direct_transfer_plus"]
    tables = {"task": "antmaze-umaze", "methods": rows}
    assert read(**tables, train=predicted, plus={"reward": "blend"}).train.reward == "predicted"
    for asked in ({"train": predicted}, {"plus": predicted}):
        with pytest.raises(
            RecipeError, match=r"plus\.reward: direct_transfer_plus predicts no reward: expected"
        ):
            read(**tables, **asked)
    for row, trained in {"nas": "nas", "direct_transfer_iql": "direct_transfer"}.items():
        with pytest.raises(RecipeError, match=rf"train\.reward: {trained} predicts no reward"):
            read(**tables | {"methods": ["astra", row]}, train=predicted)


def test_keys_that_a_table_leaves_out_are_those_of_the_method_without_it() -> None:
    rows = {"methods": ["direct_transfer_iql", "iql"]}
    recipe = read(**rows, direct_transfer_iql={"temperature": 2.5}, iql={"temperature": 2.5})
    settings = recipe.settings_of("direct_transfer_iql", "train"), recipe.settings_of("iql", "train")
    assert settings == (FINE_TUNING.model_copy(update={"temperature": 2.5}), IqlConfig(temperature=2.5))
    assert read(**recipe.settings) == recipe


class MyConfig(Config):
    rate: float = 0.5


def test_the_table_of_a_new_method_is_read() -> None:
    tables = [Table("mine", MyConfig), Table("yours", MyConfig, default=MyConfig(rate=2.0))]
    model = with_tables(Recipe, STAGES.values(), tables)
    recipe = validated(BASE | {"mine": {"rate": 0.7}}, model, "r.toml")
    assert recipe.mine == MyConfig(rate=0.7) and recipe.yours == MyConfig(rate=2.0)
    with pytest.raises(RecipeError, match=r"mine\.rat: unknown key: did you mean 'rate'"):
        validated(BASE | {"mine": {"rat": 0.7}}, model, "r.toml")


def test_settings_are_those_of_the_rows_method_for_the_stage_that_takes_them() -> None:
    rows = ["iql", "behavior_cloning", "direct_transfer_iql", "target", "full_obs", "astra"]
    recipe = read(methods=rows, iql={"batch_windows": 5}, target={"num_envs": 3})
    assert recipe.settings_of("iql", "train") == IqlConfig(batch_windows=5)
    assert recipe.settings_of("behavior_cloning", "train") == IqlConfig(batch_windows=5)
    assert recipe.settings_of("direct_transfer_iql", "train") == FINE_TUNING
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


def test_stages_get_their_tables_and_plus_rows_theirs() -> None:
    recipe = read(
        train={"num_envs": 8},
        plus={"num_envs": 4},
        collect={"start": "task", "episodes": 40},
        sweep={"percent": [50]},
    )
    assert recipe.config_of("train", "astra").num_envs == 8  # type: ignore[union-attr]
    assert recipe.config_of("train", "astra_plus").num_envs == 4  # type: ignore[union-attr]
    assert recipe.config_of("evaluate", "astra_plus") == recipe.evaluate
    # What is collected is the largest size.
    assert recipe.config_of("collect").episodes == 20  # type: ignore[union-attr]
    assert recipe.config_of("subset") is None
    assert "select" not in recipe.settings, "a choice is made where a recipe asks for one"


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"train": {"learner": "foo"}}, "train.learner: expected 'ppo' or 'sac', got 'foo'"),
        ({"train": {"burn_in": 4}}, "train.burn_in: unknown key: 'sac' has it, not 'ppo'"),
        ({"train": SAC | {"clip": 0.1}}, "train.clip: unknown key: 'ppo' has it, not 'sac'"),
        ({"train": SAC | {"windw": 9}}, "train.windw: unknown key: did you mean 'window'?"),
        ({"train": SAC, "plus": {"learner": "ppo"}}, "expected that of [train], 'sac', got 'ppo'"),
        ({"train": SAC | {"ramp": 0.4}}, "train: ramp: expected 0 with SAC"),
        ({"plus": {"ramp_while": 0.9}}, "plus: ramp_while: expected a ramp, a share of the training"),
        ({"train": SAC, "methods": ["rma"]}, "methods: rma: expected train.learner 'ppo', got 'sac'"),
        ({"train": SAC, "methods": ["rma_plus"]}, "methods: rma: expected train.learner 'ppo', got 'sac'"),
        (
            {"train": {"disagreement_penalty": 1.0}},
            "disagreement_penalty: expected ground.correction_heads of 2 or more, or keep_member",
        ),
        ({"plus": {"keep_member": True}}, "keep_member: expected ground.members of 2 or more, got 0"),
        (
            {"ground": {"members": 1}, "train": {"keep_member": True}},
            "keep_member: expected ground.members of 2 or more, got 1",
        ),
        ({"train": 3}, "train: expected a table, got 3"),
        ({"domain_randomization": 3}, "domain_randomization: expected a table, got 3"),
        ({"domain_randomization": {"ball_friction": [0.5, 2.0]}}, "expected ranges of"),
        ({"train": {"hidden_sizes": [0]}}, "train.hidden_sizes.0: expected greater than or equal to 1"),
        ({"train": {"memory_size": -1}}, "train.memory_size: expected greater than or equal to 0"),
        (
            {"ground": {"position_octaves": -1}},
            "ground.position_octaves: expected greater than or equal to 0",
        ),
        ({"align": {"bandwidths": [1.0, 0.0]}}, "align.bandwidths.1: expected greater than 0"),
        (
            {"collect": {"start": "task", "hold_s": [3.0, 0.5]}},
            "collect.hold_s: expected the lower end first, got [3.0, 0.5]",
        ),
        ({"collect": {"start": "task", "episodes": 10**18}}, "collect.episodes: expected less than or equal"),
        ({"collect": {"start": "task", "episodes": 10**10}}, "collect: episodes: 10000000000 of up to 500"),
        (
            {"sweep": {"percent": [50], "ground.latent_weight": [0, 1]}},
            "sweep: expected percent alone, got ground.latent_weight: for values of another setting",
        ),
        ({"sweep": {"percent": [10**9]}}, "sweep.percent.0: expected less than or equal to 10000"),
        (
            {"task": "antmaze-umaze", "sweep": {"percent": [50]}, "augment": {"copies": 2}},
            "sweep.percent: counts recorded episodes, but [augment] adds copies",
        ),
        ({"train": {"num_envs": 10**9}}, "train.num_envs: expected less than or equal to 1000000"),
        ({"train": {"hidden_sizes": [10**9]}}, "train.hidden_sizes.0: expected less than or equal to"),
        ({"evaluate": {"episodes": 10**9}}, "evaluate.episodes: expected less than or equal to 1000000"),
        ({"task": "antmaze-umaze", "collect": {"behavior": "suboptimal_sac"}}, "use 'suboptimal_ppo'"),
        (
            {"task": "humanoid-kinematics", "plus": {"ramp": 0.5, "ramp_while": 0.9}},
            "ramp_while: no episode of humanoid-kinematics succeeds before its end: expected 0",
        ),
    ],
)
def test_what_does_not_fit_the_learner_is_told_in_a_line(tables: dict[str, Any], message: str) -> None:
    with pytest.raises(RecipeError, match=f"^r.toml: .*{re.escape(message)}") as caught:
        read(**tables)
    assert "\n" not in str(caught.value)


def test_a_method_of_ones_own_that_is_not_there_is_told_once() -> None:
    with pytest.raises(RecipeError, match=r"own_methods: .*nothing\.py") as caught:
        read(own_methods={"mine": "nothing.py:METHOD"}, methods=["mine"])
    assert "unknown method" not in str(caught.value)


def test_disagreement_is_that_of_heads_or_of_members() -> None:
    penalty = {"disagreement_penalty": 1.0}
    by_heads = read(ground={"correction_heads": 2}, plus=penalty)
    by_members = read(ground={"members": 2}, plus=penalty | {"keep_member": True})
    assert by_heads.plus.disagreement_penalty == by_members.plus.disagreement_penalty == 1.0


@pytest.mark.parametrize("seed", [-1, 2**63, 2**64])
def test_seeds_are_those_that_every_stage_takes(seed: int) -> None:
    assert read(seeds=[0, 2**63 - 1]).seeds[1] == 2**63 - 1
    with pytest.raises(RecipeError, match=r"seeds\.1: "):
        read(seeds=[0, seed])
