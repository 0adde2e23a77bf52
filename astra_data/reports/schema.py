"""Results: what results.json holds. A row's lists are over its seeds, in the order of its `seeds`."""

from typing import Annotated, Literal

from pydantic import AliasChoices, BaseModel, BeforeValidator, ConfigDict, Field, JsonValue

from astra_data.reports.statistics import Comparison, Correlation, Summary
from astra_data.worlds.score import SUCCESS, Score


def _nan_for_null(value: object) -> object:
    return float("nan") if value is None else value


Number = Annotated[float, BeforeValidator(_nan_for_null)]
"""JSON knows no NaN: it is written as null and read back."""


class Section(BaseModel):
    """A frozen part of the results."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Machine(Section):
    """A machine that something was made on."""

    cpu: str
    cores: int
    memory_gib: float
    gpu: str | None = None
    """Where the networks ran on one."""


class Origin(Section):
    """What some stages' artefacts say of their making; None or empty where they do not say."""

    commit: str | None
    """Of the code, ending in "-dirty" where it was changed since."""
    machine: Machine | None
    packages: dict[str, str | None]
    stages: list[str]
    """"report" for what is drawn and simulated by the report itself."""


class DatasetOrigin(Section):
    """A dataset that the recipe wrote."""

    stage: str
    seed: int
    name: str
    version: str
    content_hash: str


class DatasetUse(Section):
    """The dataset of each seed, as the evaluations of rows recorded it."""

    versions: list[str | None]
    hashes: list[str | None]
    methods: list[str]


class Learning(Section):
    """One seed's training."""

    steps: list[float]
    score: list[Number] = Field(validation_alias=AliasChoices("score", "success"))
    """The headline of the training episodes that ended, wherever in the task they began."""


class BandMeans(Section):
    """An error at each horizon, averaged over seeds."""

    mean: list[Number]
    low: list[Number]
    high: list[Number]


class GapMeans(Section):
    """Open-loop error by horizon for each quantity, averaged over seeds."""

    seeds: list[int]
    horizons: list[int]
    """Steps ahead."""
    grounded: dict[str, BandMeans]
    raw: dict[str, BandMeans]


class Cost(Section):
    """The time that one seed of a stage takes, on average."""

    wall_seconds: float
    cpu_seconds: float | None
    """Of all threads; None where it was not recorded."""


class Validity(Section):
    """How well the return in a simulator foretells that in the target, over policies: rows and seeds."""

    policies: int
    pearson: Correlation | None
    """None where it is undefined: for fewer than three policies, or where all have the same return."""
    spearman: Correlation | None


class MethodResults(Section):
    """One row. Each measure is a list over seeds of means over episodes in the target."""

    title: str
    role: str | None
    """"floor", "ceiling" or "trained there", in the target, of the rows that others are seen against."""
    seeds: list[int]
    """Those that are finished."""
    success: list[float]
    failed: list[float]
    wall_contact: list[float]
    """Share of steps in contact with a wall."""
    steps: list[float]
    """Length of an episode in control steps."""
    returns: list[float] = Field(
        validation_alias=AliasChoices("return", "returns"), serialization_alias="return"
    )
    distance: list[Number]
    """Way of the robot in an episode that succeeds, in m; NaN for a seed where none does."""
    simulated_success: list[float] | None
    """Success in the simulator that the policy was trained in; None for a row that was in none."""
    simulated_steps: list[float] | None = None
    """Length of an episode there, likewise."""
    simulator_returns: dict[str, list[float]]
    """Return in the simulators that all rows are tested in, "raw" and "grounded", where the row was."""
    encoders: dict[str, dict[str, list[float]]]
    """The same measures by encoder, where a row has more than one."""
    summary: dict[str, Summary] = Field(default_factory=dict)
    """Every measure over seeds; of the distance over those that have one."""
    grounding: str | None
    """Name of the row's folder of groundings, which rows may share."""
    gap: GapMeans | None
    learning: list[Learning]
    """Empty for a row that is not trained."""
    cost: dict[str, Cost]
    """By stage; with the grounding and alignment that it uses, though other rows may share them."""

    def measures(self) -> dict[str, list[float] | None]:
        """Return every measure over seeds by its name; None for one that the row has not."""
        return {
            "success": self.success,
            "failed": self.failed,
            "wall_contact": self.wall_contact,
            "steps": self.steps,
            "return": self.returns,
            "simulated_success": self.simulated_success,
            "simulated_steps": self.simulated_steps,
            "distance": self.distance,
        }


class Results(Section):
    """All that the page and the figures show."""

    format: Literal[1] = 1
    recipe: str
    task: str
    command: str
    """The command that produced these results."""
    scores: tuple[Score, ...] = (SUCCESS,)
    """What the rows are compared by, the headline first."""
    settings: dict[str, JsonValue]
    """Of the recipe, with its defaults."""
    origins: list[Origin]
    """Normally one; more if code or machine changed on the way."""
    wall_seconds: dict[str, float]
    """By stage over all rows and seeds, and "total"; stages that record no time are left out."""
    cpu_seconds: dict[str, float]
    """The same of all threads."""
    datasets: list[DatasetOrigin]
    evaluated_with: list[DatasetUse]
    seeds: list[int] = Field(default_factory=list)
    """Of which rows may have finished only some."""
    episodes: int
    """Per row and seed."""
    leg_scale: float = 1.0
    """Of the target's robot, which the data was not collected with if it is not 1."""
    stand_in: str | None = None
    """What stands in for a physical robot in the target, where something does."""
    methods: dict[str, MethodResults]
    paper_success: dict[str, float] = Field(default_factory=dict)
    """Row → the success rate that the paper prints for it."""
    unfinished: list[str] = Field(default_factory=list)
    """Titles of the recipe's rows that no seed of is finished yet."""
    probability_of_improvement: dict[str, dict[str, Comparison]] = Field(default_factory=dict)
    """ASTRA's row → another that is trained alike → how likely a seed of the one beats one of the other."""
    predictive_validity: dict[str, Validity] = Field(default_factory=dict)
    """Of the simulators that all rows are tested in: "raw", and "grounded" where there is one."""
    throughput: dict[str, dict[str, dict[str, list[float]]]]
    """stage → figure → row, or grounding that rows share, or "all" → one value per seed."""

    @property
    def headline(self) -> Score:
        """The first of the scores."""
        return self.scores[0]

    def gaps(self) -> dict[str, GapMeans]:
        """Return each grounding's gap once, though rows share it."""
        return {
            row.grounding: row.gap
            for row in self.methods.values()
            if row.grounding is not None and row.gap is not None
        }
