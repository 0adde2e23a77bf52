"""What a recipe may say: task, rows, seeds and sizes, and a table of settings per stage and method."""

from typing import Any, Self

from pydantic import (
    Field,
    JsonValue,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
    model_validator,
)

from astra_data.core.config import Config, Count, did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.core.naming import PLUS, base_method, is_plus
from astra_data.dataset.edit import share
from astra_data.grounding.fit import GroundConfig
from astra_data.learning.iql import FINE_TUNING, IqlConfig
from astra_data.learning.rma import RmaConfig
from astra_data.methods import METHODS
from astra_data.methods.compass import CompassConfig
from astra_data.methods.nas_golemo import GolemoConfig
from astra_data.stages.align import AlignConfig
from astra_data.stages.augment import AugmentConfig
from astra_data.stages.collect import CollectConfig
from astra_data.stages.evaluate import EvaluateConfig
from astra_data.stages.pair import PairConfig
from astra_data.stages.report import ReportConfig
from astra_data.training.train import AnyTrainConfig
from astra_data.training.train_in_target import TargetConfig
from astra_data.worlds.registry import TASKS
from astra_data.worlds.score import Score
from astra_data.worlds.variation import AnyVariation

STAGES: dict[str, tuple[str, ...]] = {
    "collect": (),
    "augment": ("collect",),
    "pair": ("collect", "augment"),
    "subset": ("pair",),
    "ground": ("pair", "subset"),
    "train": ("pair", "subset", "ground"),
    "align": ("pair", "subset", "ground"),
    "evaluate": ("train", "ground", "align"),
    "report": ("evaluate",),
}
"""Each stage, in order, and the stages whose artefacts it reads. Not every recipe augments."""

METHOD_TABLES = {
    "domain_randomization": "train",
    "compass": "ground",
    "compass_uniform": "train",
    "rma": "train",
    "nas_golemo": "ground",
    "iql": "train",
    "direct_transfer_iql": "train",
    "target": "train",
}
"""Methods with settings of their own in a recipe, and the stage that they are for."""


DERIVED = {"compass_uniform": "compass"}
"""Those of them that are read off another one."""

WHOLE = 100
"""Per cent of a dataset that is not swept over."""


class SweepConfig(Config):
    """Over which sizes of the dataset the rows are repeated."""

    percent: tuple[Count, ...] = ()
    """In per cent of `collect.episodes`; smaller ones lie inside larger ones. By default the whole."""


class Recipe(Config):
    """One experiment: which methods, on which task, with which seeds and settings."""

    task: str
    """A name in `astra_data.worlds.registry.TASKS`."""
    methods: tuple[str, ...] = Field(min_length=1)
    """Rows of the results: a name in `astra_data.methods.METHODS`, by itself or followed by `_plus`."""
    seeds: tuple[int, ...] = Field(min_length=1)
    """Each seed repeats everything, from the collected dataset on."""
    collect: CollectConfig
    augment: AugmentConfig | None = None
    """How each collected dataset is augmented before it is paired; by default not at all."""
    pair: PairConfig
    ground: GroundConfig
    train: AnyTrainConfig
    align: AlignConfig
    evaluate: EvaluateConfig
    report: ReportConfig
    based_on: str | None = None
    """The recipe that all that is not said here, and every artefact it leaves unchanged, is taken from."""
    sweep: SweepConfig = SweepConfig()
    plus: AnyTrainConfig
    """The training of `_plus` rows: the recipe's `[plus]` table laid over `[train]`."""
    domain_randomization: AnyVariation
    """What domain randomization varies, laid over the task's ranges for it."""
    nas_golemo: GolemoConfig = GolemoConfig()
    """How the residual model of Golemo et al. is fitted."""
    rma: RmaConfig = RmaConfig()
    """How the student of rapid motor adaptation learns."""
    target: TargetConfig = TargetConfig()
    """The training of `target` and `full_obs`, laid over `[train]`."""
    compass: CompassConfig
    """The ranges of `compass` and `compass_uniform`, laid over the task's, and how the former identifies its
    parameters."""
    iql: IqlConfig = IqlConfig()
    """How IQL learns."""
    direct_transfer_iql: IqlConfig = FINE_TUNING
    """How direct transfer is fine-tuned; by default gently, for it unlearns more than it learns."""

    @property
    def settings(self) -> dict[str, JsonValue]:
        """All that it says, with the defaults, as JSON values."""
        return self.model_dump(mode="json")

    @property
    def headline(self) -> Score:
        """What its rows are compared by above all."""
        return TASKS[self.task].objective.scores[0]

    def settings_of(self, table: str) -> Config:
        """Return the settings of a method; of ranges to train in, those that the task's simulator has."""
        varied = TASKS[self.task].varied
        if table == "compass_uniform":
            return self.compass.of_kind(type(varied.wide))
        if table == "domain_randomization":
            return self.domain_randomization.of_kind(type(varied.randomized))
        settings: Config = getattr(self, table)
        return settings

    @model_validator(mode="before")
    @classmethod
    def _add_empty_sections(cls, tables: dict[str, Any]) -> dict[str, Any]:
        needed = {name for name, field in cls.model_fields.items() if field.is_required()}
        return {table: {} for table in (*STAGES, "plus", *METHOD_TABLES) if table in needed} | tables

    @field_validator("plus", mode="before")
    @classmethod
    def _lay_over_train(cls, overrides: Any, info: ValidationInfo) -> Any:  # noqa: ANN401 - checked next
        train = info.data.get("train")
        if train is None or not isinstance(overrides, dict):
            return overrides
        if (asked := overrides.get("learner", train.learner)) != train.learner:
            raise ValueError(f"learner: expected that of [train], '{train.learner}', got '{asked}'")
        return train.model_dump() | overrides

    @field_validator("domain_randomization", "compass", mode="wrap")
    @classmethod
    def _lay_over_ranges(
        cls,
        overrides: Any,  # noqa: ANN401 - `check` tells
        check: ValidatorFunctionWrapHandler,
        info: ValidationInfo,
    ) -> Any:  # noqa: ANN401 - what `check` returns
        if "task" not in info.data or not isinstance(overrides, dict):
            return check(overrides)
        varied = TASKS[info.data["task"]].varied
        usual = varied.wide if info.field_name == "compass" else varied.randomized
        ranges = check(usual.model_dump() | overrides)
        try:
            ranges.of_kind(type(usual))
        except BadInputError as error:
            raise ValueError(str(error)) from None
        return ranges

    @field_validator("task")
    @classmethod
    def _is_known_task(cls, task: str) -> str:
        if task not in TASKS:
            raise ValueError(f"unknown task '{task}'{did_you_mean(task, TASKS)}")
        return task

    @field_validator("methods")
    @classmethod
    def _are_known_methods(cls, rows: tuple[str, ...]) -> tuple[str, ...]:
        for row in rows:
            if base_method(row) not in METHODS:
                raise ValueError(f"unknown method '{row}'{did_you_mean(base_method(row), METHODS)}")
            if is_plus(row) and not METHODS[base_method(row)].in_simulator:
                raise ValueError(
                    f"'{row}' trains nothing in a simulator, so the [plus] settings are without effect: "
                    f"leave out {PLUS}"
                )
        return rows

    @model_validator(mode="after")
    def _fits_the_learner(self) -> Self:
        if self.train.learner != "ppo" and "rma" in map(base_method, self.methods):
            raise ValueError(f"methods: rma: expected train.learner 'ppo', got '{self.train.learner}'")
        if self.collect.behavior == "suboptimal_sac" and not TASKS[self.task].objective.is_lasting:
            raise ValueError(f"collect: good episodes of {self.task} are short: take 'suboptimal_ppo'")
        return self

    @model_validator(mode="after")
    def _has_heads_to_disagree(self) -> Self:
        penalised = self.train.disagreement_penalty or self.plus.disagreement_penalty
        if penalised and self.ground.correction_heads < 2:
            raise ValueError("disagreement_penalty: expected ground.correction_heads of 2 or more, got 1")
        return self

    @model_validator(mode="after")
    def _has_rewards_to_learn_from(self) -> Self:
        begun = [METHODS[base_method(row)].initial for row in self.methods]
        for row in (*self.methods, *filter(None, begun)):
            table = "plus" if is_plus(row) else "train"
            if not METHODS[base_method(row)].learns_from(getattr(self, table).reward):
                raise ValueError(
                    f"{table}.reward: {row} predicts none: expected 'abstract' or 'blend', got 'predicted'"
                )
        return self

    @model_validator(mode="after")
    def _limits_all_commands(self) -> Self:
        rows = {row: METHODS[base_method(row)] for row in self.methods}
        elsewhere = [row for row, method in rows.items() if method.trains and not method.in_simulator]
        if self.train.limits_commands and elsewhere:
            raise ValueError(
                f"train.command_limit_m_s: it does not reach {', '.join(elsewhere)}, which no simulator "
                "trains: leave these rows out, or give it in [plus]"
            )
        return self

    @model_validator(mode="after")
    def _fits_the_task(self) -> Self:
        if TASKS[self.task].plane is not None:
            return self
        faults = [f"methods: {row}" for row in self.methods if METHODS[base_method(row)].planar]
        asked = {
            "augment": self.augment is not None,
            'collect.start = "anywhere" (the default; "task" does not)': self.collect.start == "anywhere",
            "collect.clearance_m": self.collect.clearance_m > 0,
            "train.support_penalty": self.train.support_penalty > 0,
            "train.command_limit_m_s": self.train.limits_commands,
            "plus.support_penalty": self.plus.support_penalty > 0,
            "plus.command_limit_m_s": self.plus.limits_commands,
            "evaluate.leg_scale": self.evaluate.leg_scale != 1.0,
            "report.paper_success": bool(self.report.paper_success),
        }
        if faults := faults + [setting for setting, is_asked in asked.items() if is_asked]:
            needing = ", ".join(faults)
            raise ValueError(f"{self.task} has no maze, which these need: {needing}; leave them out")
        return self

    @model_validator(mode="after")
    def _has_no_repeats(self) -> Self:
        axes = {"methods": self.methods, "seeds": self.seeds, "sweep.percent": self.sweep.percent}
        for name, values in axes.items():
            if len(set(values)) < len(values):
                raise ValueError(f"expected each of {name} once, got {list(values)}")
        return self

    @model_validator(mode="after")
    def _has_no_empty_size(self) -> Self:
        for percent in self.sweep.percent:
            if not share(percent, self.collect.episodes):
                raise ValueError(
                    f"sweep.percent: {percent} % of {self.collect.episodes} episodes are none: expected more"
                )
        return self

    @property
    def largest(self) -> int:
        """The largest size, in per cent of `collect.episodes`: as much is collected."""
        return max(self.sweep.percent, default=WHOLE)
