"""The model of recipes, their files, and the methods of the user's: task, rows, seeds, sizes, tables of settings."""

import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import BeforeValidator, Field, JsonValue, ValidationInfo, create_model, field_validator, model_validator

from astra_data.core.config import Config, Seed, as_fault, load_tables, read_written, validated
from astra_data.core.errors import BadInputError, RecipeError
from astra_data.core.naming import PLUS, RECORD, base_method, is_plus
from astra_data.dataset.edit import share
from astra_data.dataset.format import INFO_PATH
from astra_data.io.mapping import refuse_mapping
from astra_data.methods import METHODS, add_method, is_of_package, method_named, offered_methods, tables
from astra_data.pipeline.shipped import whereabouts
from astra_data.pipeline.stages.registry import STAGES, Stage
from astra_data.pipeline.stages.select import judge_of
from astra_data.reports.artifacts import WrittenPart
from astra_data.reports.results import WHOLE
from astra_data.reports.runs import recorded_code
from astra_data.robots.registry import place_of, task_named
from astra_data.worlds.user_code import code_digest, place_beside

_FILLED: Any = Field(default_factory=dict, validate_default=True)
"""A table that a recipe leaves out is read as an empty one."""


def _stage_field(stage: Stage) -> tuple[Any, Any]:
    if stage.name == "collect":
        return stage.config | None, _FILLED
    if stage.name == "align":
        return Annotated[stage.config, BeforeValidator(_held_out_as_ground)], _FILLED
    return (stage.config | None, None) if stage.asked_by else (stage.config, _FILLED)


def _held_out_as_ground(table: object, info: ValidationInfo) -> object:
    """Hold out what `[ground]` does: an alignment would be judged on what grounding trained on."""
    if "ground" not in info.data or not isinstance(table, dict):
        return table
    if table.get("inputs") and info.data.get("data") is None:
        raise ValueError("inputs: expected a recipe with `data`, since `collect` records states alone")
    share = info.data["ground"].held_out_share
    if (asked := table.get("held_out_share", share)) != share:
        raise ValueError(f"held_out_share: expected that of [ground], {share!r}, got {asked!r}")
    return {"held_out_share": share} | table


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
        advice = "restore that version, or run the recipe under another name"
        raise BadInputError(f"{place.rpartition(':')[0]} changed since {run} was made: {advice}")


def digests_of(task: str, user_methods: Mapping[str, UserMethod]) -> dict[str, str]:
    """Return the digest of the code of "task", and of methods by their names, where it is the user's."""
    places = {"task": place_of(task)} | {name: own.method for name, own in user_methods.items()}
    found = {name: code_digest(place) for name, place in places.items()}
    return {name: digest for name, digest in found.items() if digest}


class _Record(WrittenPart, extra="allow"):
    """What is read of a record before it is known to be a recipe of today."""

    task: str
    user_methods: dict[str, UserMethod] = Field(default_factory=dict)
    sweep: dict[str, JsonValue] = Field(default_factory=dict)


def recorded_settings(folder: Path) -> dict[str, Any]:
    """Return the settings that the run in `folder` was made with."""
    advice = "restore it from a copy, or move the folder away and run the recipe again"
    return read_written(_Record, folder / RECORD, by="a run", advice=advice).model_dump(exclude_unset=True)


def read_tables(path: Path) -> dict[str, Any]:
    """Return the tables of a recipe; files of the user's, and data in a folder, are looked up beside it."""
    if os.path.isdir(path):  # of a name that is too long, too, `load_tables` tells
        whole = path.absolute()
        run = next((folder for folder in (whole, *whole.parents) if (folder / RECORD).is_file()), None)
        if kind := "a run" if run == whole else "a dataset" if (path / INFO_PATH).is_file() else "":
            made_by = f", {run.name}.toml" if run else ""
            raise RecipeError(f"{path} is {kind}: expected the recipe that made it{made_by}")
    if not os.path.exists(path) and (place := whereabouts(path.name.removesuffix(".toml"))):
        raise RecipeError(f"{path} does not exist: {place}")
    tables = load_tables(path)
    refuse_mapping(tables, path)
    task, data = tables.get("task"), tables.get("data")
    if isinstance(task, str):
        tables["task"] = place_beside(task, path.parent)
    if isinstance(own := tables.get("user_methods"), dict):
        tables["user_methods"] = looked_up(own, path.parent)
    if isinstance(data, str) and (path.parent / data / INFO_PATH).is_file():
        tables["data"] = str(path.parent / data)
    return tables


class SweepConfig(Config):
    """The sizes of the dataset on which the rows are repeated."""

    percent: tuple[Annotated[int, Field(ge=1, le=10_000)], ...] = ()
    """Percentages of `collect.episodes`, or of the episodes of `data`; smaller sets are contained in larger
    ones. By default the whole dataset."""

    @model_validator(mode="before")
    @classmethod
    def _sweeps_sizes_alone(cls, table: Any) -> Any:  # noqa: ANN401 - checked next
        if other := [key for key in table if key != "percent"] if isinstance(table, dict) else []:
            fault = f"expected percent alone, got {', '.join(other)}"
            raise ValueError(f"{fault}: for values of another setting write recipes with based_on")
        return table


class Recipe(Config):
    """One experiment: which methods, on which task, with which seeds and settings.

    Below `seeds` come a table for each stage, `based_on`, `sweep`, and the methods' tables: `_FIELDS`.
    """

    task: str
    """A task of this package or of an installed one, or in a file next to the recipe: "cart.py:TASK"."""
    data: str | None = None
    """A dataset instead of `[collect]`: a folder next to the recipe, what dataset commands take (a folder, a
    name in the home folder, "walks@data-1.0.0"), or what `pull` takes ("user/name", "s3://…")."""
    user_methods: dict[str, UserMethod] = Field(default_factory=dict)
    """Your own methods, by the names of their rows: "delta.py:METHOD", or a table of that and settings."""
    methods: tuple[str, ...] = Field(min_length=1)
    """Rows of the results: a name in `astra_data.methods.METHODS`, alone or followed by `_plus`."""
    seeds: tuple[Seed, ...] = Field(min_length=1)
    """For each seed everything is repeated, starting with collecting the dataset."""

    if TYPE_CHECKING:

        def __getattr__(self, table: str) -> Any: ...  # noqa: ANN401 - each table has its own model

    @property
    def settings(self) -> dict[str, JsonValue]:
        """All settings as JSON values, as a run records them."""
        return self.model_dump(mode="json")

    def settings_of(self, row: str, stage: str) -> Config | None:
        """Return the settings of a row's method, if it has any and `stage` takes them."""
        name = base_method(row)
        method = METHODS[name]
        if method.table is None or method.configures != stage:
            return None
        own = self.user_methods.get(name)
        return own.settings(name) if own else getattr(self, method.table.name)

    def config_of(self, stage: str) -> Config | None:
        """Return the settings of a stage; None where it has none."""
        config: Config | None = getattr(self, stage, None)
        if stage != "collect" or config is None or self.largest == WHOLE:
            return config
        return config.model_copy(update={"episodes": share(self.largest, self.collect.episodes)})

    @model_validator(mode="before")
    @classmethod
    def _has_data_or_collects(cls, tables: Any) -> Any:  # noqa: ANN401 - checked next
        if not isinstance(tables, dict):
            return tables
        tables = with_offered(tables, cls.model_fields)
        if tables.get("data") is None:
            return tables
        if tables.get("collect") is not None:
            raise ValueError("data replaces [collect]: leave out one of them")
        return tables | {"collect": None}

    @field_validator("task")
    @classmethod
    def _is_known_task(cls, task: str) -> str:
        with as_fault():
            task_named(task)
        return task

    @field_validator("user_methods")
    @classmethod
    def _add_user_methods(cls, methods: dict[str, UserMethod]) -> dict[str, UserMethod]:
        with as_fault():
            add_all(methods)
        return methods

    @field_validator("methods")
    @classmethod
    def _are_known_methods(cls, rows: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        if "user_methods" not in info.data:
            return rows  # told already
        for row in rows:
            with as_fault():
                if is_plus(row) and not method_named(row).in_simulator:
                    fault = "trains nothing in a simulator, so plus settings have no effect: leave out"
                    raise ValueError(f"'{row}' {fault} {PLUS}")
                initial = method_named(row).initial
                if initial and (method_named(initial).grounds or not method_named(initial).trains):
                    fault = f"'{row}' starts from the policy of {initial}"
                    raise ValueError(f"{fault}: expected a method that learns one, and fits nothing")
        return rows

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.train.learner != "ppo" and "rma" in map(base_method, self.methods):
            raise ValueError(f"methods: rma: expected train.learner 'ppo', got '{self.train.learner}'")
        collects_by = self.collect and self.collect.behavior
        if collects_by == "suboptimal_sac" and not task_named(self.task).objective.is_lasting:
            raise ValueError(f"collect: good episodes of {self.task} are short: use 'suboptimal_ppo'")
        uncounted = "[augment] adds copies of these" if self.augment else ""
        if self.collect and self.collect.least_steps:
            uncounted = "collect.least_steps may record fewer"
        if uncounted and self.sweep.percent:
            raise ValueError(f"sweep.percent: counts recorded episodes, but {uncounted}: leave out one of the two")
        for name, values in {"methods": self.methods, "seeds": self.seeds, "sweep.percent": self.sweep.percent}.items():
            if len(set(values)) < len(values):
                raise ValueError(f"expected each of {name} once, got {list(values)}")
        if self.collect is None and self.largest > WHOLE:
            raise ValueError(f"sweep.percent: expected at most {WHOLE} % of data, got {self.largest}")
        if self.collect and (none := [size for size in self.sweep.percent if not share(size, self.collect.episodes)]):
            raise ValueError(f"sweep.percent: {none[0]} % of {self.collect.episodes} episodes are none: expected more")
        if self.select is None:
            return self
        with as_fault("select.judge: "):
            judge_of(self.select.judge, self.methods)
        if len(self.seeds) < 2:
            fault = "expected two seeds or more, got 1 (judges are of other seeds)"
            raise ValueError(f"select: {fault}: remove [select], or add a seed")
        if not any(method_named(row).trains_without_target for row in self.methods):
            raise ValueError("select: expected a row with policies of abstract states, got none")
        return self

    @model_validator(mode="after")
    def _fits_the_task(self) -> Self:
        needing = [f"methods: {row}" for row in self.methods if method_named(row).steps_target]
        task = task_named(self.task)
        if needing and task.has_target and task.make_target is None and self.train.data_start_share:
            fault = f"train.data_start_share: robots of {self.task} cannot be put into recorded states, where"
            raise ValueError(f"{fault} these would start: {', '.join(needing)}: expected 0")
        needing += ['[collect] (give `data = "…"` in its place)'] if self.data is None else []
        if needing and not task.has_target:
            raise ValueError(f"{self.task} has no target, which these need: {', '.join(needing)}")
        if task.plane is not None:
            if "leg_scale" not in task.facts and self.evaluate.leg_scale != 1.0:
                raise ValueError(f"evaluate.leg_scale: {self.task} has legs of one length: expected 1")
            return self
        faults = [f"methods: {row}" for row in self.methods if method_named(row).planar]
        asked = {
            "augment": self.augment is not None,
            'collect.start = "anywhere"': self.collect and self.collect.start == "anywhere",
            "collect.clearance_m": self.collect and self.collect.clearance_m > 0,
            "evaluate.leg_scale": self.evaluate.leg_scale != 1.0,
            "report.paper_success": bool(self.report.paper_success),
        }
        if faults := faults + [setting for setting, is_asked in asked.items() if is_asked]:
            raise ValueError(f"{self.task} has no maze, which these need: {', '.join(faults)}; leave them out")
        return self

    @property
    def largest(self) -> int:
        """The largest size, in per cent of the episodes: as much is collected."""
        return max(self.sweep.percent, default=WHOLE)


_ABOUT = "The recipe of the settings that are not given here, and of the artifacts that do not change."
_FIELDS: dict[str, Any] = {stage.name: _stage_field(stage) for stage in STAGES.values() if stage.config}
_FIELDS["based_on"] = (str | None, Field(default=None, description=_ABOUT))
_FIELDS["sweep"] = (SweepConfig, SweepConfig())
_FIELDS |= {name: (table.model, table.model()) for name, table in tables().items()}
if not TYPE_CHECKING:
    Recipe = create_model(Recipe.__name__, __base__=Recipe, __module__=__name__, **_FIELDS)
