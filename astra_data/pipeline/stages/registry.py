"""All stages of the pipeline by name: what each reads, its settings, and what makes its artifacts."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from astra_data.grounding.files import GROUNDING, TARGET_ENCODER
from astra_data.grounding.fit import GroundConfig
from astra_data.pipeline.stages.align import AlignConfig, align
from astra_data.pipeline.stages.augment import AugmentConfig, augment
from astra_data.pipeline.stages.collect import CollectConfig, collect
from astra_data.pipeline.stages.evaluate import EvaluateConfig, evaluate
from astra_data.pipeline.stages.ground import ground
from astra_data.pipeline.stages.label import label
from astra_data.pipeline.stages.pair import PairConfig, pair
from astra_data.pipeline.stages.report import ReportConfig, report
from astra_data.pipeline.stages.select import SelectConfig, select
from astra_data.pipeline.stages.subset import subset
from astra_data.pipeline.stages.train import train
from astra_data.policies.running_policy import POLICY
from astra_data.policies.train import AnyTrainConfig
from astra_data.reports.artifacts import EVALUATION
from astra_data.reports.choice import SELECTED


@dataclass(frozen=True)
class Stage:
    """One step of the pipeline: `run` makes one artifact, and `plan` gives it what its parameters name."""

    name: str
    run: Callable[..., object]
    each: Literal["seed", "size", "grounding", "policy", "alignment", "row", "recipe"]
    """What it makes one artifact for; all but the seed, its sizes and the recipe once per dataset."""
    config: Any = None  # the type of its table in a recipe; None where it has no settings
    asked_by: str | None = None  # the key of recipes without which the stage is left out; None if all have it
    result: str | None = None  # the file of its artifacts that other stages read; None for datasets and the report

    @property
    def makes_dataset(self) -> bool:
        """Whether its artifacts are datasets."""
        return self.each in ("seed", "size")


STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        Stage("collect", collect, "seed", CollectConfig, "collect"),
        Stage("label", label, "seed", asked_by="data"),
        Stage("augment", augment, "seed", AugmentConfig, "augment"),
        Stage("pair", pair, "seed", PairConfig),
        Stage("subset", subset, "size"),
        Stage("ground", ground, "grounding", GroundConfig, result=GROUNDING),
        Stage("train", train, "policy", AnyTrainConfig, result=POLICY),
        Stage("align", align, "alignment", AlignConfig, result=TARGET_ENCODER),
        Stage("select", select, "recipe", SelectConfig, "select", SELECTED),
        Stage("evaluate", evaluate, "row", EvaluateConfig, result=EVALUATION),
        Stage("report", report, "recipe", ReportConfig),
    )
}  # in the order of the pipeline: a dataset is made of the one before it
