"""The recipe of a study, a TOML file."""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from astra_data.core.config import Config, Positive, Seed, did_you_mean
from astra_data.studies.joints import JointsConfig
from astra_data.studies.rollouts import FITS, FitConfig
from astra_data.studies.sequences import StepsConfig
from astra_data.studies.walking import WalkingConfig


class GapRecipe(Config):
    """How well models of a robot's walk, or of its joints, predict recordings of it."""

    mapping: str
    """How logs become columns: a mapping of `astra-data import`, relative to the recipe."""
    models: Annotated[tuple[str, ...], Field(min_length=1)]
    """Names in `rollouts.FITS`; the raw simulator is always added."""
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1)]
    """Seeds of the networks, and of the choice of pieces for smaller data sizes."""
    minutes: tuple[Positive, ...] = ()
    """Sizes of the training data, in addition to all of it; each is a subset of the larger ones."""
    horizons_s: Annotated[tuple[Positive, ...], Field(min_length=1)] = (0.5, 1.0, 2.0, 3.0)
    """Prediction horizons, in addition to one step; rounded to control steps, at least one."""
    held_out_share: Annotated[float, Field(gt=0, lt=1)] = 0.25
    """Fraction of each recording's pieces to hold out for testing, if no other recordings are given."""
    notes: tuple[str, ...] = ()
    """Paragraphs for the page, such as which data was used for tuning."""
    simulator: Literal["planar_walker", "joints"] = "planar_walker"
    """The abstract simulator, which decides what is predicted: a walk in the plane, or joints that follow
    targets."""
    walking: WalkingConfig = WalkingConfig()
    """When a robot counts as walking."""
    joints: JointsConfig = JointsConfig()
    """How the joints' simulator responds."""
    steps: StepsConfig = StepsConfig()
    """How rows become control steps."""
    fit: FitConfig = FitConfig()
    """Settings of fitting."""

    @field_validator("models")
    @classmethod
    def _are_known(cls, models: tuple[str, ...]) -> tuple[str, ...]:
        for name in models:
            if name not in FITS:
                raise ValueError(f"unknown model '{name}'{did_you_mean(name, FITS)}")
        return ("raw", *(name for name in dict.fromkeys(models) if name != "raw"))

    @field_validator("seeds", "minutes")
    @classmethod
    def _are_no_repeats(cls, values: tuple[float, ...]) -> tuple[float, ...]:
        if len(set(values)) < len(values):
            raise ValueError(f"expected each once, got {list(values)}")
        return values

    @property
    def reading(self) -> WalkingConfig | JointsConfig:
        """How recordings are read."""
        return self.joints if self.simulator == "joints" else self.walking
