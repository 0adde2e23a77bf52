"""The tables of recipes: their types and defaults, by stage and by method."""

from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationInfo

from astra_data.methods.method import Table
from astra_data.pipeline.stages.registry import Stage

_FILLED: Any = Field(default_factory=dict, validate_default=True)
"""A table that a recipe leaves out is read as an empty one."""


def stage_field(stage: Stage) -> tuple[Any, Any]:
    """Return the type and the default of a stage's table."""
    if stage.name == "collect":
        return stage.config | None, _FILLED
    if stage.name == "align":
        # It would be judged on what grounding trained on.
        return Annotated[stage.config, _agreeing("ground", "held_out_share")], _FILLED
    if stage.name == "select":
        return stage.config | None, Field(default=None, exclude_if=lambda table: table is None)
    return (stage.config | None, None) if stage.asked_by else (stage.config, _FILLED)


def method_field(table: Table) -> tuple[Any, Any]:
    """Return the type and the default of a method's table."""
    return Annotated[table.model, BeforeValidator(table.over_usual)], table.usual


def _agreeing(table: str, key: str) -> BeforeValidator:
    """Return what takes `key` from `table`, and refuses another value of it."""

    def read(overrides: object, info: ValidationInfo) -> object:
        other = info.data.get(table)
        if other is None or not isinstance(overrides, dict):
            return overrides
        expected = getattr(other, key)
        if (asked := overrides.get(key, expected)) != expected:
            raise ValueError(f"{key}: expected that of [{table}], {expected!r}, got {asked!r}")
        return {key: expected} | overrides

    return BeforeValidator(read)
