"""Recipes: TOML files read into strict, frozen models; one message lists every fault of a file."""

import json
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, Tag, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from astra_data.core.errors import BadInputError, RecipeError
from astra_data.core.naming import first_few, shortened

Count = Annotated[int, Field(ge=1, le=10**12)]
AtOnce = Annotated[int, Field(ge=1, le=10**6)]  # a number of things that are in memory at the same time
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
CountFromZero = Annotated[int, Field(ge=0, le=10**12)]
Share = Annotated[float, Field(ge=0, le=1)]

Seed = Annotated[int, Field(ge=0, lt=2**63)]

MOST_KNOWN = 30  # names that an error lists
_UNNAMED = ""
_MOST_FAULTS = 5  # of a file that no user writes by hand
_MOST_PARTS = 64  # of a key in TOML, between dots
_EXPECTED = {
    "bool_type": "true or false",
    "float_type": "a number",
    "int_type": "a whole number",
    "model_type": "a table",
    "string_type": "a string in quotes",
    "tuple_type": "an array",
}


def in_order(ends: tuple[float, float]) -> tuple[float, float]:
    """Return the ends of a range, for annotations; raise a ValueError if the upper end is first."""
    if ends[0] > ends[1]:
        raise ValueError(f"expected the lower end first, got {list(ends)}")
    return ends


@contextmanager
def as_fault(place: str = "") -> Iterator[None]:
    """Raise a BadInputError of the block as validators do, as a ValueError."""
    try:
        yield
    except BadInputError as error:
        raise ValueError(f"{place}{error}") from None


def choice(name: str) -> str:
    """Return the tag of one of a table's alternative models; messages omit it from a key's name."""
    return f"<{name}>"


def _is_choice(part: int | str) -> bool:
    return str(part).startswith("<")


class Config(BaseModel):
    """Settings of one component: frozen, without unknown keys; an int is accepted as a float, nothing else."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


def own_settings[C: Config](given: Config | None, usual: C) -> C:
    """Return the settings that a component was given, by default its `usual` ones, if they are its own."""
    if given is None:
        return usual
    if not isinstance(given, type(usual)):
        raise BadInputError(f"expected settings of {type(usual).__name__}, got {type(given).__name__}")
    return given


def only_given(**options: Any) -> dict[str, Any]:
    """Return the options that are not None: those to be set, where None stands for the usual value."""
    return {key: value for key, value in options.items() if value is not None}


def as_json(**settings: Config | str | int | None) -> str:
    """Return settings as JSON, by their names."""
    plain = {k: v.model_dump(mode="json") if isinstance(v, Config) else v for k, v in settings.items()}
    return json.dumps(plain, indent=1)


def load_recipe[M: BaseModel](path: Path, model: type[M]) -> M:
    """Read the recipe at `path` into `model`; a RecipeError holds all faults. TOML arrays become tuples."""
    return validated(load_tables(path), model, str(path))


def load_tables(path: Path) -> dict[str, Any]:
    """Read the TOML file at `path` as it is, or raise a RecipeError."""
    try:
        text = path.read_text(encoding="utf-8-sig")  # some editors put a mark before the text
    except FileNotFoundError:
        nearby = [str(file) for file in sorted(path.parent.glob("*.toml"))]
        raise RecipeError(f"{path} does not exist{did_you_mean(str(path), nearby)}") from None
    except IsADirectoryError:
        raise RecipeError(f"{path} is a folder: expected a TOML file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise RecipeError(f"{path} cannot be read as a text file: {error}") from None
    for number, line in enumerate(text.splitlines(), 1):
        # The parser takes time with the square of a key's parts.
        keys = re.split(r"[,=\[\]{}]", line.replace(" ", "").replace("\t", ""))
        if any(len(list(filter(None, key.split(".")))) > _MOST_PARTS for key in keys):
            raise RecipeError(f"{path} line {number}: a key of more than {_MOST_PARTS} parts")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        fault, _, place = str(error).rpartition(" (at ")
        found = re.match(r"line (\d+)", place)
        at = found[1] if found else text.count("\n") + 1
        raise RecipeError(f"{path}, line {at}: not valid TOML: {fault}") from None
    except ValueError as error:  # a number of more digits than Python takes
        raise RecipeError(f"{path} cannot be read as TOML: {error}") from None
    except RecursionError:
        raise RecipeError(f"{path} is nested too deeply") from None


def validated[M: BaseModel](tables: Mapping[str, Any], model: type[M], origin: str) -> M:
    """Read `tables`, which come from `origin`, into `model` as `load_recipe` does."""
    try:
        return model.model_validate(_with_tuples(dict(tables)))
    except RecursionError:
        raise RecipeError(f"{origin} is nested too deeply") from None
    except ValidationError as error:
        found = error.errors(include_url=False)
        # Of a list with a wrong entry the right ones alone are counted.
        within = {one["loc"][:depth] for one in found for depth in range(len(one["loc"]))}
        faults = [_fault(one, model) for one in found if one["type"] != "too_short" or one["loc"] not in within]
    if len(faults) == 1:
        raise RecipeError(f"{origin}: {faults[0]}")
    raise RecipeError("\n  ".join([f"{origin} has {len(faults)} errors:", *faults]))


def faults_of(error: ValidationError) -> str:
    """Return what is wrong in a file that no user writes by hand: where, and what was expected."""
    faults = [f"{'.'.join(map(str, one['loc'])) or 'file'}: {one['msg']}" for one in error.errors(include_url=False)]
    more = [f"and {len(faults) - _MOST_FAULTS} more"] if len(faults) > _MOST_FAULTS else []
    return "; ".join([*faults[:_MOST_FAULTS], *more])


def read_written[T](kind: type[T], path: Path, *, by: str, advice: str) -> T:
    """Read the JSON file `path` that `by` writes, as `kind`; a BadInputError ends with the `advice`."""
    try:
        return TypeAdapter(kind).validate_json(path.read_bytes())
    except ValidationError as error:
        raise BadInputError(f"{path} is not what {by} writes: {faults_of(error)}; {advice}") from None


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a clause that names the closest of `known`, or lists the first `MOST_KNOWN` when none is close."""
    known = list(known)
    if close := get_close_matches(name, known, n=1):
        return f": did you mean '{close[0]}'?"
    return f"; known: {first_few(known, MOST_KNOWN)}" if known else ""


def _fault(error: ErrorDetails, model: type[BaseModel]) -> str:
    location, kind, message = error["loc"], error["type"], error["msg"].removeprefix("Value error, ")
    if not location:  # the message names the keys
        return message
    key = ".".join(str(part) for part in location if not _is_choice(part))
    match kind:
        case "extra_forbidden":
            message = f"unknown key{_key_hint(location, model)}"
        case "union_tag_invalid":
            context = error["ctx"]
            known, got = (context[name].replace("<", "").replace(">", "") for name in ("expected_tags", "tag"))
            key = f"{key}.{context['discriminator'].strip('()_')}"
            message = f"expected {known.replace(', ', ' or ')}, got '{got}'"
        case "missing":
            message = "expected a value, but the key is missing"
        case "too_short":
            least, got = error["ctx"]["min_length"], error["ctx"]["actual_length"]
            message = f"expected {least} or more, got {got or 'none'}"
        case _ if kind in _EXPECTED or message.startswith("Input should be "):
            given = list(error["input"]) if isinstance(error["input"], tuple) else error["input"]
            expected = _EXPECTED.get(kind, message.removeprefix("Input should be "))
            message = f"expected {expected}, got {shortened(repr(given), 60)}"
        case _ if kind != "value_error":
            message = f"{message[0].lower()}{message[1:]}"
    return f"{key}: {message}"


def _key_hint(location: tuple[int | str, ...], model: type[BaseModel]) -> str:
    """Return a clause on where an unknown key belongs, or which known one is like it."""
    key, section = str(location[-1]), _section(model, location[:-1])
    if len(location) > 2 and _is_choice(location[-2]):  # another alternative of the table may have it
        parent = _section(model, location[:-3])
        field = parent.model_fields.get(str(location[-3])) if parent else None
        for name, other in _nested_models(field.annotation if field else None).items():
            if key in other.model_fields:
                return f": '{name.strip('<>')}' has it, not '{str(location[-2]).strip('<>')}'"
    if section is not model and key in model.model_fields:
        return f": '{key}' belongs to no table: move it above the first [table]"
    fields = list(section.model_fields) if section else []
    elsewhere = {dotted.rpartition(".")[2]: dotted for dotted in _dotted_keys(model)}
    close = get_close_matches(key, elsewhere, n=1, cutoff=0.8)
    if close and not get_close_matches(key, fields):
        return f": did you mean '{elsewhere[close[0]]}'?"
    return did_you_mean(key, fields)


def _section(model: type[BaseModel], location: Iterable[int | str]) -> type[BaseModel] | None:
    """Follow `location` through the nested models; None where it leaves them."""
    section: type[BaseModel] | None = model
    choices: dict[str, type[BaseModel]] = {}
    parts = iter(location)
    for part in parts:
        if part not in choices:
            field = section.model_fields.get(str(part)) if section else None
            choices = _nested_models(field.annotation) if field else {}
            if field is not None and get_origin(field.annotation) is dict:
                next(parts, None)  # a key of any name, whose values are of the section
            part = _UNNAMED
        section = choices.get(str(part))
    return section


def _nested_models(annotation: Any) -> dict[str, type[BaseModel]]:  # noqa: ANN401 - an annotation is any object
    """Return the models that `annotation` allows, by their tags where there are several."""
    found: dict[str, type[BaseModel]] = {}
    for candidate in (annotation, *get_args(annotation)):
        kind, *marks = get_args(candidate) if get_origin(candidate) is Annotated else (candidate,)
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            found[next((mark.tag for mark in marks if isinstance(mark, Tag)), _UNNAMED)] = kind
    return found


def _dotted_keys(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    for name, field in model.model_fields.items():
        yield prefix + name
        for nested in _nested_models(field.annotation).values():
            yield from _dotted_keys(nested, f"{prefix}{name}.")


def _with_tuples(value: object) -> object:
    if isinstance(value, dict):
        return {key: _with_tuples(item) for key, item in value.items()}
    return tuple(_with_tuples(item) for item in value) if isinstance(value, list) else value
