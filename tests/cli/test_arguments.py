import subprocess
import sys
from typing import Any

import pytest
from typer.main import get_command

from astra_data.cli.app import app
from astra_data.cli.arguments import settings_of
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
    read = settings_of(f"{model.__module__}:{model.__name__}")
    assert [(one.name, one.default) for one in read] == [
        (name, one.default) for name, one in model.model_fields.items()
    ]
    for one in read:
        option, kind = options[one.name], type(one.default)
        assert option.help.split() == one.about.replace("`", "").split() != []
        assert option.default is None and (one.default is None or one.kind in (kind, tuple[float, float]))


def test_the_stages_that_help_lists_are_those_of_the_pipeline() -> None:
    assert tuple(STAGES) == STAGE_NAMES


def test_settings_are_read_without_their_stages() -> None:
    code = "import sys, astra_data.cli.app; print('astra_data.pipeline.stages.collect' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
