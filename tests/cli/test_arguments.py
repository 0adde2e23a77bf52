from typing import Any

import pytest
from typer.main import get_command

from astra_data.cli.app import app
from astra_data.core.config import Config
from astra_data.core.naming import STAGE_NAMES
from astra_data.pipeline.stages.augment import AugmentConfig
from astra_data.pipeline.stages.collect import CollectConfig
from astra_data.pipeline.stages.pair import PairConfig
from astra_data.pipeline.stages.registry import STAGES


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


def test_stages_are_known_before_anything_is_loaded() -> None:
    assert tuple(STAGES) == STAGE_NAMES
