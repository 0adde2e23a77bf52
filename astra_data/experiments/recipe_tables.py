"""The tables of recipes: their types and defaults, by stage and by method."""

from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, ValidatorFunctionWrapHandler, WrapValidator

from astra_data.core.errors import BadInputError
from astra_data.methods.method import Table
from astra_data.stages.registry import Stage
from astra_data.worlds.registry import task_named

_FILLED: Any = Field(default_factory=dict, validate_default=True)
"""A table that a recipe leaves out is read as an empty one."""


def stage_field(stage: Stage) -> tuple[Any, Any]:
    """Return the type and the default of a stage's table."""
    if stage.name == "collect":
        return stage.config | None, _FILLED
    if stage.name == "align":
        # It would be judged on what grounding trained on.
        return Annotated[stage.config, _agreeing("ground", "held_out_share", {"held_out_share"})], _FILLED
    if stage.name == "select":
        return stage.config | None, Field(default=None, exclude_if=lambda table: table is None)
    return (stage.config | None, None) if stage.asked_by else (stage.config, _FILLED)


def plus_field(train: Any, default: Any) -> tuple[Any, Any]:  # noqa: ANN401 - a type and a pydantic field
    """Return the type and the default of the training of `_plus` rows, which is laid over `train`."""
    return Annotated[train, _agreeing("train", "learner", None)], default


def method_field(table: Table) -> tuple[Any, Any]:
    """Return the type and the default of a method's table."""
    if table.ranges is None:
        return Annotated[table.model, BeforeValidator(table.over_usual)], table.usual
    return Annotated[table.model, WrapValidator(_laid_over(table.ranges))], _FILLED


def _agreeing(table: str, key: str, taken: set[str] | None) -> BeforeValidator:
    """Return what lays a table over the settings `taken`, or all, of `table`, and refuses another `key`."""

    def read(overrides: object, info: ValidationInfo) -> object:
        other = info.data.get(table)
        if other is None or not isinstance(overrides, dict):
            return overrides
        expected = getattr(other, key)
        if (asked := overrides.get(key, expected)) != expected:
            raise ValueError(f"{key}: expected that of [{table}], {expected!r}, got {asked!r}")
        return other.model_dump(include=taken) | overrides

    return BeforeValidator(read)


def _laid_over(ranges: Literal["randomized", "wide"]) -> Callable[..., Any]:
    """Return how a table of ranges is read: laid over `ranges` of the recipe's task."""

    def read(overrides: object, check: ValidatorFunctionWrapHandler, info: ValidationInfo) -> object:
        if "task" not in info.data or not isinstance(overrides, dict):
            return check(overrides)
        usual = getattr(task_named(info.data["task"]).varied, ranges)
        found = check(usual.model_dump() | overrides)
        try:
            found.of_kind(type(usual))
        except BadInputError as error:
            raise ValueError(str(error)) from None
        return found

    return read
