from typing import Any

import pytest
from typer.main import get_command

from astra_data.cli.app import app
from astra_data.core.config import Config
from astra_data.stages.augment import AugmentConfig
from astra_data.stages.collect import CollectConfig
from astra_data.stages.pair import PairConfig


@pytest.mark.parametrize(
    ("command", "model"), [("augment", AugmentConfig), ("collect", CollectConfig), ("pair", PairConfig)]
)
def test_the_defaults_that_help_shows_are_those_of_the_settings(command: str, model: type[Config]) -> None:
    """They are written out in the command's options, so that help need not import the stage."""
    group: Any = get_command(app)
    shown = {param.name: param.show_default for param in group.commands[command].params}
    options = {name: field.default for name, field in model.model_fields.items() if name in shown}
    assert options
    for name, default in options.items():
        if isinstance(default, bool):
            assert shown[name] == ("" if default else "no-") + name.replace("_", "-")
        elif isinstance(default, float | int):
            assert float(shown[name]) == default
        elif isinstance(default, tuple):
            assert [*map(float, shown[name].split())] == [*default]
        elif default is not None:
            assert shown[name] == default
