"""The page of the reference about the command line, from the commands themselves."""

from typing import Any

from pages.markdown import plain, table
from typer.core import TyperGroup
from typer.main import get_command

from astra_data.cli.app import app

_INTRODUCTION = """# The command line

Every command with its arguments and options, as `--help` prints them. `--help` shows examples, too.
"""


def command_line() -> str:
    """Return the page: a section for each command, also those of groups, with its options in a table."""
    top: Any = get_command(app)
    context = top.context_class(top, info_name="astra-data")
    return _INTRODUCTION + _section(top, context)


def _section(command: Any, context: Any) -> str:  # noqa: ANN401 - Typer's own copy of Click has no public types
    parts = [
        f"\n## {context.command_path}\n",
        f"{plain(command.help)}\n",
        f"```text\n{context.get_usage().removeprefix('Usage: ')}\n```\n",
    ]
    records = [_record(parameter, context) for parameter in command.params]
    if records:
        parts.append(table(("option", "what it does"), records))
    if isinstance(command, TyperGroup):
        for name in command.list_commands(context):
            nested = command.get_command(context, name)
            assert nested is not None
            parts.append(_section(nested, nested.context_class(nested, info_name=name, parent=context)))
    return "\n".join(parts)


def _record(parameter: Any, context: Any) -> tuple[str, str]:  # noqa: ANN401 - as above
    names, meaning = parameter.get_help_record(context)
    return f"`{names}`", plain(meaning)
