from typing import Any

import pytest
from typer.main import get_command

from astra_data.cli.app import app
from astra_data.core.config import Config
from astra_data.core.naming import METHOD_NAMES, STAGE_NAMES, TASK_NAMES
from astra_data.methods import METHODS, tables
from astra_data.pipeline.executors import EXECUTORS
from astra_data.pipeline.first_look import ENGINES, KEYS, TABLES, fields_of
from astra_data.pipeline.recipe import Recipe
from astra_data.pipeline.stages.augment import AugmentConfig
from astra_data.pipeline.stages.collect import CollectConfig
from astra_data.pipeline.stages.pair import PairConfig
from astra_data.pipeline.stages.registry import STAGES
from astra_data.policies.train import PpoTrainConfig, SacTrainConfig
from astra_data.robots.registry import TASKS


@pytest.mark.parametrize(
    ("command", "model"), [("augment", AugmentConfig), ("collect", CollectConfig), ("pair", PairConfig)]
)
def test_a_command_has_an_option_for_each_setting(command: str, model: type[Config]) -> None:
    group: Any = get_command(app)
    options = {one.name: one for one in group.commands[command].params}
    for name, field in model.model_fields.items():
        option = options[name]
        assert option.help.split() == (field.description or "").replace("`", "").split() != []
        assert option.default is None
    assert {name for name in options if name in model.model_fields} == set(model.model_fields)


def test_names_and_keys_that_are_known_before_anything_is_loaded() -> None:
    assert tuple(STAGES) == STAGE_NAMES
    assert {*TASKS} == {*TASK_NAMES} and {*METHODS} == {*METHOD_NAMES} and {*EXECUTORS} == {*ENGINES}
    assert {*Recipe.model_fields} == {*KEYS, *TABLES}
    models = {name: [stage.config] for name, stage in STAGES.items() if stage.config}
    models |= {name: [table.model] for name, table in tables().items()}
    models["train"] = [PpoTrainConfig, SacTrainConfig]
    for name, of in models.items():
        known = {field.target.id for place in TABLES[name] for field, _ in fields_of(place)}
        assert known == {key for model in of for key in model.model_fields}, name
