"""The way into a tool: what is wrong with its input is told in one line, as by the commands."""

import sys
from collections.abc import Callable

import typer

from astra_data.core.errors import AstraDataError


def run_tool(main: Callable[..., None]) -> None:
    """Run the tool `main` with the arguments of the command line."""
    try:
        typer.run(main)
    except AstraDataError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
