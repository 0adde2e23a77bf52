import re
from pathlib import Path

import pytest
from typer.core import TyperGroup
from typer.main import get_command

from astra_data.cli.app import app

HOUSE = Path(__file__).parents[1]
README = (HOUSE / "README.md").read_text()
GROUP = get_command(app)
assert isinstance(GROUP, TyperGroup)
COMMANDS = GROUP.commands
SET_UP = "pip install uv && uv run astra-data run recipes/quickstart.toml"
TEST = "pip install uv && uv run pytest"


@pytest.mark.parametrize("command", [SET_UP, TEST])
def test_the_set_up_commands_stand_alone_on_a_line(command: str) -> None:
    assert command in README.splitlines()


def test_the_checks_call_the_test_command() -> None:
    assert TEST in (HOUSE / ".ci" / "run").read_text().splitlines()


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_is_in_the_table_and_has_help(name: str) -> None:
    assert re.search(rf"^\| `[^`]*astra-data {name}\b", README, re.MULTILINE)
    assert COMMANDS[name].help
    assert all(getattr(parameter, "help", "") for parameter in COMMANDS[name].params)


def test_the_table_names_no_command_that_is_not_there() -> None:
    assert set(re.findall(r"^\| `[^`]*astra-data (\w+)", README, re.MULTILINE)) == set(COMMANDS)


def test_links_and_figures_lead_somewhere() -> None:
    linked = re.findall(r"\]\((?!https?:)([^)#]+)\)", README)
    assert linked
    assert [link for link in linked if not (HOUSE / link).exists()] == []


def test_nothing_is_left_to_fill_in() -> None:
    assert re.findall(r"^[A-Z_]{4,}$|\b[A-Z]+_MINUTES\b", README, re.MULTILINE) == []


def test_the_code_compiles() -> None:
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert blocks
    for block in blocks:
        compile(block, "README.md", "exec")
