"""The page of the reference about recipes: every key with its type, default, unit and meaning."""

import json
import re
from collections.abc import Iterable, Mapping
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pages.markdown import plain, table
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from astra_data.methods import METHODS
from astra_data.pipeline.recipe import Recipe
from astra_data.pipeline.stages.registry import STAGES

_INTRODUCTION = """# Keys of recipes

A [recipe](../guide/recipes.md) is a TOML file with the keys of the first table here and one table `[…]` for
each section below it. A key that is left out has its default; without one it is not set, and its meaning
says what happens then. Units are those of the key's name. Numbers of things are at most 10¹², of things that
are in memory at the same time 10⁶.
"""
UNITS = {"m_s": "m/s", "s": "s", "m": "m", "deg": "°", "steps": "steps", "episodes": "episodes", "percent": "%"}
"""By the last words of a key's name."""
_SAFETY = 10**6
"""Bounds from here on are those of the introduction."""
_KINDS = {bool: "true or false", int: "whole number", float: "number", str: "string"}
_HEAD = ("key", "type", "default", "unit", "meaning")


def recipe_keys() -> str:
    """Return the page."""
    nested = {name: _models(field.annotation) for name, field in Recipe.model_fields.items()}
    plain = {name: field for name, field in Recipe.model_fields.items() if not nested[name]}
    sections = [_section(name, models) for name, models in nested.items() if models]
    return "\n".join([_INTRODUCTION, _key_table(plain), *sections])


def _section(name: str, models: list[type[BaseModel]]) -> str:
    if name == "user_methods":
        return _titled("user_methods.NAME", models[0], _key_table(models[0].model_fields))
    if name == "plus":
        return (
            "## `[plus]`\n\nThe training of rows with `_plus`: the keys of [`[train]`](#train), laid "
            "over what the recipe has there. A key that is left out has its value from `[train]`.\n"
        )
    if len(models) > 1:
        return _choice(name, models)
    return _titled(name, models[0], _key_table(models[0].model_fields))


def _titled(name: str, model: type[BaseModel], keys: str) -> str:
    about = " ".join(filter(None, (_about(model), _presence(name))))
    return f"## `[{name}]`\n\n{about}\n\n{keys}"


def _about(model: type[BaseModel]) -> str:
    return plain(" ".join((model.__doc__ or "").split()))


def _presence(name: str) -> str:
    """Return for whom a table is: a stage that runs only with it, or the methods that read it."""
    if name in STAGES:
        key = STAGES[name].asked_by
        if key != name or Recipe.model_fields[name].default_factory:
            return ""
        return "Without this table the stage is left out."
    readers = [f"`{m.name}`" for m in METHODS.values() if m.table and m.table.name == name]
    return f"Read by {', '.join(readers)}." if readers else ""


def _choice(name: str, models: list[type[BaseModel]]) -> str:
    """Return the section of a table whose model depends on `learner`: the keys of all, and of each."""
    shared = {
        key: field
        for key, field in models[0].model_fields.items()
        if all(repr(model.model_fields.get(key)) == repr(field) for model in models)
    }
    parts = [f"## `[{name}]`\n\nThe keys of every learner:\n\n{_key_table(shared)}"]
    for model in models:
        own = {key: field for key, field in model.model_fields.items() if key not in shared}
        (learner,) = get_args(model.model_fields["learner"].annotation)
        parts.append(f'### `[{name}] learner = "{learner}"`\n\n{_about(model)}\n\n{_key_table(own)}')
    return "\n".join(parts)


def _key_table(fields: Mapping[str, FieldInfo]) -> str:
    rows = []
    for key, field in fields.items():
        kind = _kind(field.annotation, field.metadata)
        rows.append((f"`{key}`", kind, _default(field), unit(key), plain(field.description or "")))
    return f'<div class="keys" markdown>\n\n{table(_HEAD, rows)}\n</div>\n'


def unit(key: str) -> str:
    """Return the unit that the end of a key's name tells; empty if it has none."""
    ends = re.compile(rf"(?:^|_)({'|'.join(UNITS)})$")
    found = ends.search(key)
    return UNITS[found[1]] if found else ""


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    return "" if value is None else f"`{json.dumps(value, ensure_ascii=False)}`"


def _kind(
    annotation: Any,  # noqa: ANN401 - an annotation is any object
    metadata: Iterable[object] = (),
    *,
    several: bool = False,
) -> str:
    """Return a type in the words of TOML, or what `several` of it are."""
    marks = list(metadata)
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        of = [mark for part in arguments[1:] for mark in getattr(part, "metadata", [part])]
        return _kind(arguments[0], of, several=several)
    if origin in (Union, UnionType):
        return " or ".join(_kind(argument, marks) for argument in arguments if argument is not NoneType)
    if origin is Literal:
        return ", ".join(f"`{json.dumps(value)}`" for value in arguments)
    if origin is tuple:
        count = "" if arguments[-1] is Ellipsis else f"{len(arguments)} "
        return f"array of {count}{_kind(arguments[0], several=True)}"
    if origin is dict:
        return f"table of {_kind(arguments[1], several=True)}"
    return " ".join([_KINDS[annotation] + "s" * several, *_bounds(marks)])


def _bounds(marks: Iterable[object]) -> list[str]:
    bounds = []
    for mark in marks:
        match mark:
            case Ge(ge=bound):
                bounds.append(f"≥ {bound}")
            case Gt(gt=bound):
                bounds.append(f"> {bound}")
            case Le(le=int() | float() as bound) if bound < _SAFETY:
                bounds.append(f"≤ {bound}")
            case Lt(lt=bound):
                bounds.append(f"&lt; {bound}")
    return [", ".join(bounds)] if bounds else []


def _models(annotation: Any) -> list[type[BaseModel]]:  # noqa: ANN401 - an annotation is any object
    """Return the models of tables that an annotation allows."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in get_args(annotation) for model in _models(argument)]
