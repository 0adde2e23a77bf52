"""Which settings of a recipe differ from those that artifacts were made with."""

import json
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from astra_data.core.config import validated
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.core.naming import RECORD, first_few, shortened
from astra_data.dataset.description import changed_values
from astra_data.pipeline.recipe import WHOLE, Recipe
from astra_data.pipeline.staleness import SIMULATOR
from astra_data.pipeline.user_code import OwnMethod
from astra_data.robots.registry import task_named

_MOST_KEYS = 3
_MOST_LETTERS = 60


def differences(before: Mapping[str, Any], recipe: Recipe) -> dict[str, str]:
    """Return the tables and keys of `recipe` that differ from those recorded `before`, and how.

    Settings that did not exist then have their defaults, as they took effect.
    """
    with suppress(RecipeError):
        before = validated(before, type(recipe), RECORD).settings
    before, now = _with_largest_size(dict(before)), _with_largest_size(recipe.settings)
    elsewhere = {"methods", "own_methods", "seeds", "based_on"}
    changed = {
        key: _change(before.get(key), now[key])
        for key in sorted(now.keys() - elsewhere)
        if before.get(key) != now[key]
    }
    if "task" in changed and share_target(str(before.get("task")), recipe.task):
        changed[SIMULATOR] = changed.pop("task")
    return changed


def restated(before: Mapping[str, Any], recipe: Recipe) -> set[str]:
    """Return the methods of the user's whose settings in `recipe` are others than those recorded `before`."""
    known = {name: OwnMethod.model_validate(own) for name, own in before.get("own_methods", {}).items()}
    return {
        name
        for name, own in recipe.own_methods.items()
        if name in known and not _is_set_alike(name, own, known[name])
    }


def _is_set_alike(name: str, own: OwnMethod, before: OwnMethod) -> bool:
    with suppress(BadInputError):  # it has no such settings any more
        return own.settings(name) == before.settings(name)
    return False


def share_target(task: str, other: str) -> bool:
    """Return whether two tasks are known and have the same target."""
    try:
        return task_named(task).shares_target(task_named(other))
    except BadInputError:
        return False


def _change(before: object, now: object) -> str:
    """Say what was and is, for tables key by key."""
    if not isinstance(before, dict) or not isinstance(now, dict):
        return f"{_shown(before)}, now {_shown(now)}"
    changes = [f"{key}: {_shown(old)}, now {_shown(new)}" for key, old, new in changed_values(before, now)]
    return first_few(changes, _MOST_KEYS)


def _shown(value: object) -> str:
    """Return a value as text, lists shortened, but no names: they may be paths."""
    if value is None:
        return "none"
    text = json.dumps(value, default=str)
    return text if isinstance(value, str) else shortened(text, _MOST_LETTERS)


def _with_largest_size(settings: dict[str, Any]) -> dict[str, Any]:
    """Replace `sweep` by the largest size, the only part of it that artifacts depend on."""
    percents = settings.get("sweep", {}).get("percent", ())
    return settings | {"sweep": max(percents, default=WHOLE)}
