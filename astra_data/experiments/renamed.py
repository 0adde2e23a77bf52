"""Recipes with keys that have been renamed since they were written."""

import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from astra_data.training.build_env import RENAMED


def with_current_keys(tables: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return the `tables` of the recipe at `path` with renamed keys under their current names.

    A message on standard error says so, once for each key. Where a table has both names, it is left as it is.
    """
    current = dict(tables)
    for name, table in tables.items():
        for old, new in RENAMED.items():
            if isinstance(table, dict) and old in table and new not in table:
                current[name] = {new if key == old else key: value for key, value in table.items()}
                _say(f"{path}: {name}.{old} is now called {new}: please rename it")
    return current


@cache
def _say(message: str) -> None:
    print(message, file=sys.stderr)
