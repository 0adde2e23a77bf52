import re
from typing import Any

import pytest

from astra_data.core.config import validated
from astra_data.core.errors import RecipeError
from astra_data.experiments.recipe import Recipe
from astra_data.training.train import PpoTrainConfig, SacTrainConfig

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
    limit = {"command_limit_m_s": 1.0}
    tables: dict[str, Any] = {"task": "antmaze-umaze", "methods": ["astra", "iql", "target", "follower"]}
    assert not read(**tables, plus=limit).train.limits_commands
    with pytest.raises(RecipeError, match="it does not reach iql, target, which no simulator trains"):
        read(**tables, train=limit)


def test_rows_that_predict_no_reward_are_not_trained_with_it() -> None:
    predicted, rows = {"reward": "predicted"}, ["astra", "iql", "target", "direct_transfer_plus"]
    tables = {"task": "antmaze-umaze", "methods": rows}
    assert read(**tables, train=predicted, plus={"reward": "blend"}).train.reward == "predicted"
    for asked in ({"train": predicted}, {"plus": predicted}):
        with pytest.raises(RecipeError, match=r"plus\.reward: direct_transfer_plus predicts none: expected"):
            read(**tables, **asked)
    for row, trained in {"nas": "nas", "direct_transfer_iql": "direct_transfer"}.items():
        with pytest.raises(RecipeError, match=rf"train\.reward: {trained} predicts none"):
            read(**tables | {"methods": ["astra", row]}, train=predicted)


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"train": {"learner": "foo"}}, "train.learner: expected 'ppo' or 'sac', got 'foo'"),
        ({"train": {"burn_in": 4}}, "train.burn_in: unknown key: 'sac' has it, not 'ppo'"),
        ({"train": SAC | {"clip": 0.1}}, "train.clip: unknown key: 'ppo' has it, not 'sac'"),
        ({"train": SAC | {"windw": 9}}, "train.windw: unknown key: did you mean 'window'?"),
        ({"train": SAC, "plus": {"learner": "ppo"}}, "expected that of [train], 'sac', got 'ppo'"),
        ({"train": SAC | {"ramp": 0.4}}, "train: ramp: expected 0 with SAC"),
        ({"train": SAC, "methods": ["rma"]}, "methods: rma: expected train.learner 'ppo', got 'sac'"),
        (
            {"train": {"disagreement_penalty": 1.0}},
            "disagreement_penalty: expected ground.correction_heads of 2 or more",
        ),
        ({"train": 3}, "train: expected a table, got 3"),
        ({"train": {"hidden_sizes": [0]}}, "train.hidden_sizes.0: expected greater than or equal to 1"),
        ({"train": {"memory_size": -1}}, "train.memory_size: expected greater than or equal to 0"),
        (
            {"ground": {"position_octaves": -1}},
            "ground.position_octaves: expected greater than or equal to 0",
        ),
        ({"align": {"bandwidths": [1.0, 0.0]}}, "align.bandwidths.1: expected greater than 0"),
        (
            {"collect": {"start": "task", "hold_s": [3.0, 0.5]}},
            "collect: hold_s: expected the shorter time first, got [3.0, 0.5]",
        ),
        ({"task": "antmaze-umaze", "collect": {"behavior": "suboptimal_sac"}}, "take 'suboptimal_ppo'"),
    ],
)
def test_what_does_not_fit_the_learner_is_told_in_a_line(tables: dict[str, Any], message: str) -> None:
    with pytest.raises(RecipeError, match=f"^r.toml: .*{re.escape(message)}") as caught:
        read(**tables)
    assert "\n" not in str(caught.value)
