"""The file of a recipe: its tables.

A run writes down the settings that it is made with, in recipe.json.
"""

import os
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, JsonValue

from astra_data.core.config import load_tables, read_written
from astra_data.core.errors import RecipeError
from astra_data.core.naming import RECORD
from astra_data.dataset.format import INFO_PATH
from astra_data.io.mapping import refuse_mapping
from astra_data.pipeline.own_methods import looked_up
from astra_data.worlds.own_code import place_beside


class _OwnMethod(BaseModel):
    model_config = ConfigDict(extra="allow")

    method: str


class _Record(BaseModel):
    """What is read of a record before it is known to be a recipe of today."""

    model_config = ConfigDict(extra="allow")

    task: str
    own_methods: dict[str, _OwnMethod] = {}
    sweep: dict[str, JsonValue] = {}


def recorded_settings(folder: Path) -> dict[str, Any]:
    """Return the settings that the run in `folder` was made with.

    Raises:
        BadInputError: their file is damaged.
    """
    advice = "restore it from a copy, or move the folder away and run the recipe again"
    return read_written(_Record, folder / RECORD, by="a run", advice=advice).model_dump(exclude_unset=True)


def read_tables(path: Path) -> dict[str, Any]:
    """Return the tables of a recipe; files of the user's, and data in a folder, are looked up beside it.

    Raises:
        RecipeError: it cannot be read, or is a recipe of `gap`.
    """
    tables = tables_of(path)
    if {"mapping", "models"} <= tables.keys() and "methods" not in tables:
        raise RecipeError(
            f"{path}: expected a recipe for `astra-data run`, got one for `astra-data gap {path} --data LOGS`"
        )
    task, data = tables.get("task"), tables.get("data")
    if isinstance(task, str):
        tables["task"] = place_beside(task, path.parent)
    if isinstance(own := tables.get("own_methods"), dict):
        tables["own_methods"] = looked_up(own, path.parent)
    if isinstance(data, str) and (path.parent / data / INFO_PATH).is_file():
        tables["data"] = str(path.parent / data)
    return tables


def is_gap_recipe(path: Path) -> bool:
    """Return whether the file at `path` has the keys of a recipe for `astra-data gap`.

    Raises:
        RecipeError: as `tables_of`.
    """
    return {"mapping", "models"} <= tables_of(path).keys()


def tables_of(path: Path) -> dict[str, Any]:
    """Return the tables of the file of a recipe as they are.

    Raises:
        RecipeError: it cannot be read; of a run, a dataset or a mapping in its place, it says so.
    """
    if os.path.isdir(path):  # of a name that is too long, too, `load_tables` tells
        _refuse_folder(path)
    tables = load_tables(path)
    refuse_mapping(tables, path)
    return tables


def _refuse_folder(path: Path) -> None:
    """Refuse a run or a dataset; name the recipe that made it, if that is known."""
    whole = path.absolute()
    run = next((folder for folder in (whole, *whole.parents) if (folder / RECORD).is_file()), None)
    kind = "a run" if run == whole else "a dataset" if (path / INFO_PATH).is_file() else ""
    if kind:
        made_by = f", {run.name}.toml" if run else ""
        raise RecipeError(f"{path} is {kind}: expected the recipe that made it{made_by}")
