"""Recipes with keys that have been renamed since they were written."""

import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from astra_data.core.errors import RecipeError
from astra_data.training.build_env import RENAMED


def with_current_keys(tables: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return the `tables` of the recipe at `path` with renamed keys under their current names.

    A message on standard error says so, once for each key.

    Raises:
        RecipeError: a table has a key by both names.
    """
    current = dict(tables)
    for name, table in tables.items():
        for old, new in RENAMED.items():
            if isinstance(table, dict) and old in table:
                if new in table:
                    raise RecipeError(
                        f"{path}: {name} has both {old} and {new}, its current name: remove {old}"
                    )
                current[name] = {new if key == old else key: value for key, value in table.items()}
                _say(f"{path}: {name}.{old} is now called {new}: please rename it")
    return current


@cache
def _say(message: str) -> None:
    print(message, file=sys.stderr)
