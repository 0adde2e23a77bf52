"""The code of the user's that a recipe names: methods, by a place or a table of the place and settings."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from pydantic import model_validator

from astra_data.core.config import Config, validated
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.core.naming import base_method
from astra_data.methods import METHODS, add_method, is_of_package, offered_methods
from astra_data.reports.runs import recorded_code
from astra_data.robots.registry import place_of
from astra_data.worlds.user_code import code_digest, place_beside


class UserMethod(Config, extra="allow"):
    """A method of your own; further keys are its settings, which the model of its `table` reads."""

    method: str
    """A file next to the recipe, "delta.py:METHOD", or "package.module:METHOD"; its code is run."""

    @model_validator(mode="before")
    @classmethod
    def _may_be_a_place_alone(cls, given: Any) -> Any:  # noqa: ANN401 - checked next
        return {"method": given} if isinstance(given, str) else given

    def settings(self, name: str) -> Config | None:
        """Return the settings of the method, which was added by `name`; None if it has none."""
        given, table = self.model_extra or {}, METHODS[name].table
        if table is None and given:
            raise BadInputError(f"{name}: {self.method} has no settings, got {', '.join(given)}")
        try:
            return validated(given, table.model, name) if table else None
        except RecipeError as error:
            raise BadInputError(str(error)) from None


def add_all(user_methods: Mapping[str, Any]) -> None:
    """Add the methods of a recipe, each as the recipe names it, and check their settings."""
    for name, given in user_methods.items():
        own = UserMethod.model_validate(given)
        add_method(name, own.method)
        own.settings(name)


def looked_up(user_methods: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the methods of a recipe in `folder`, their files looked up there; what is no table is left."""
    found = {}
    for name, given in user_methods.items():
        table = {"method": given} if isinstance(given, str) else given
        if isinstance(table, dict) and isinstance(table.get("method"), str):
            table = table | {"method": place_beside(table["method"], folder)}
        found[name] = table
    return found


def with_offered(tables: Mapping[str, Any], keys: Collection[str]) -> dict[str, Any]:
    """Return the `tables` of a recipe with the methods that installed packages offer among `user_methods`."""
    rows, own = tables.get("methods", ()), tables.get("user_methods", {})
    if not isinstance(rows, list | tuple) or not isinstance(own, Mapping):
        return dict(tables)
    names = {base_method(row) for row in rows if isinstance(row, str)} | {*tables}
    names = {name for name in names - {*keys} - own.keys() if not is_of_package(name)}
    found = {name: place for name, place in offered_methods().items() if name in names} if names else {}
    given = {name: table for name in found if isinstance(table := tables.get(name, {}), dict)}
    taken = {name: table | {"method": found[name]} for name, table in given.items()}
    rest = {key: value for key, value in tables.items() if key not in taken}
    return rest | {"user_methods": {**own, **taken}} if taken else rest


def check_unchanged(place: str, run: Path, *, name: str = "task") -> None:
    """Refuse code at a `place` that is not what a run's folder has recorded of its task, or of a method."""
    place = place_of(place) if name == "task" else place
    now = code_digest(place)
    if now and now != recorded_code(run).get(name, now):
        raise BadInputError(
            f"{place.rpartition(':')[0]} changed since {run} was made: "
            "restore that version, or run the recipe under another name"
        )


def digests_of(task: str, user_methods: Mapping[str, UserMethod]) -> dict[str, str]:
    """Return the digest of the code of "task", and of methods by their names, where it is the user's."""
    places = {"task": place_of(task)} | {name: own.method for name, own in user_methods.items()}
    found = {name: code_digest(place) for name, place in places.items()}
    return {name: digest for name, digest in found.items() if digest}
