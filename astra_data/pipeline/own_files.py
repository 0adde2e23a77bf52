"""The code of the user's that a recipe names: what was made with it is outdated once it changes."""

import json
from pathlib import Path

from astra_data.core.durable import write_file
from astra_data.core.errors import BadInputError
from astra_data.core.naming import CODE
from astra_data.pipeline.recipe import Recipe
from astra_data.reports.runs import recorded_code
from astra_data.robots.registry import place_of
from astra_data.worlds.code_digest import code_digest

_SETTINGS = ".settings"


def changed_code(recipe: Recipe, folder: Path) -> dict[str, str]:
    """Return what was recorded in `folder` and is another now.

    Returns:
        "task" and names of methods, each to what of it changed: its file, or its settings.

    Raises:
        BadInputError: the record is damaged.
    """
    before = recorded_code(folder)
    now = _digests(recipe)
    changed = [name for name, digest in before.items() if now.get(name, digest) != digest]
    return {
        name.removesuffix(_SETTINGS): f"the settings of {name.removesuffix(_SETTINGS)}"
        if name.endswith(_SETTINGS)
        else Path(_places(recipe)[name].rpartition(":")[0]).name
        for name in changed
    }


def check_unchanged(place: str, run: Path, *, name: str = "task") -> None:
    """Refuse code at a `place` that is not what the folder of a run has recorded of its task, or of a method.

    That of an installed task may be its name.

    Raises:
        BadInputError: it is another, or the record is damaged.
    """
    place = place_of(place) if name == "task" else place
    now = code_digest(place)
    if now and now != recorded_code(run).get(name, now):
        raise BadInputError(
            f"{place.rpartition(':')[0]} changed since {run} was made: "
            "restore that version, or run the recipe under another name"
        )


def record_code(recipe: Recipe, folder: Path) -> None:
    """Write down in `folder` what the code is now, if there is any; that of other methods stays written."""
    if digests := _digests(recipe):
        write_file(folder / CODE, json.dumps(recorded_code(folder) | digests, indent=1) + "\n")


def _places(recipe: Recipe) -> dict[str, str]:
    return {"task": place_of(recipe.task)} | {name: own.method for name, own in recipe.own_methods.items()}


def _digests(recipe: Recipe) -> dict[str, str]:
    found = {name: code_digest(place) for name, place in _places(recipe).items()}
    for name, own in recipe.own_methods.items():
        if settings := own.settings(name):
            found[f"{name}{_SETTINGS}"] = settings.model_dump_json()
    return {name: digest for name, digest in found.items() if digest}
