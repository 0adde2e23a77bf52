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
        return Annotated[stage.config, BeforeValidator(_held_out_as_in_ground)], _FILLED
    if stage.name == "select":
        return stage.config | None, Field(default=None, exclude_if=lambda table: table is None)
    return (stage.config | None, None) if stage.asked_by else (stage.config, _FILLED)


def plus_field(train: Any, default: Any) -> tuple[Any, Any]:  # noqa: ANN401 - a type and a pydantic field
    """Return the type and the default of the training of `_plus` rows, which is laid over `train`."""
    return Annotated[train, BeforeValidator(_laid_over_train)], default


def method_field(table: Table) -> tuple[Any, Any]:
    """Return the type and the default of a method's table."""
    if table.ranges is None:
        return table.model, table.usual
    return Annotated[table.model, WrapValidator(_laid_over(table.ranges))], _FILLED


def _laid_over_train(overrides: object, info: ValidationInfo) -> object:
    train = info.data.get("train")
    if train is None or not isinstance(overrides, dict):
        return overrides
    if (asked := overrides.get("learner", train.learner)) != train.learner:
        raise ValueError(f"learner: expected that of [train], '{train.learner}', got '{asked}'")
    return train.model_dump() | overrides


def _held_out_as_in_ground(align: object, info: ValidationInfo) -> object:
    """Let alignment hold out the episodes that grounding does: it would be judged on what that trained on."""
    ground = info.data.get("ground")
    if ground is None or not isinstance(align, dict):
        return align
    if (asked := align.get("held_out_share", ground.held_out_share)) != ground.held_out_share:
        raise ValueError(f"held_out_share: expected that of [ground], {ground.held_out_share}, got {asked}")
    return {"held_out_share": ground.held_out_share} | align


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
