"""Results: the content of results.json. A row's lists are over its seeds, in the order of `seeds`."""

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import AliasChoices, BaseModel, BeforeValidator, ConfigDict, Field, JsonValue

from astra_data.reports.statistics import Comparison, Correlation, Summary
from astra_data.worlds.score import SUCCESS, Score


def _nan_for_null(value: object) -> object:
    return float("nan") if value is None else value


NullableFloat = Annotated[float, BeforeValidator(_nan_for_null)]
"""A float whose NaN is null in JSON."""


class Section(BaseModel):
    """A section of the results; frozen, without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)


class Machine(Section):
    """The machine that a stage ran on."""

    cpu: str
    cores: int
    memory_gib: float
    gpu: str | None = None
    """None where the networks ran on the CPU."""


class Origin(Section):
    """Code, machine and packages that some stages ran with; None or empty where not recorded."""

    commit: str | None
    """Ends in "-dirty" if there were uncommitted changes."""
    machine: Machine | None
    packages: dict[str, str | None]
    stages: list[str]
    """Names of those stages; "report" is the report itself."""


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
    score: list[NullableFloat]
    """Headline score of the training episodes that ended, from all start states."""


class BandMeans(Section):
    """An error at each horizon, averaged over seeds; no interval where a seed has none."""

    mean: list[NullableFloat]
    low: list[NullableFloat | None]
    high: list[NullableFloat | None]


class GapMeans(Section):
    """Open-loop error by horizon for each quantity, averaged over seeds."""

    seeds: list[int]
    horizons: list[int]
    """Steps ahead."""
    grounded: dict[str, BandMeans]
    raw: dict[str, BandMeans]
    still: dict[str, BandMeans] | None = Field(default=None, exclude_if=lambda still: still is None)
    """Of who expects the robot to stay where it is; None where a seed has not measured it."""

    def at(self, band: BandMeans, horizon: int) -> tuple[float, float | None, float | None]:
        """Return mean, low and high of one of its bands at one of its horizons."""
        index = self.horizons.index(horizon)
        return band.mean[index], band.low[index], band.high[index]


def judged_horizon(horizons: Sequence[int]) -> int:
    """Return the steps ahead at which simulators are judged: the most of ten or less, if any are."""
    return max(horizon for horizon in horizons if horizon <= max(10, min(horizons)))


def shared_horizons(of_each: Sequence[Sequence[int]]) -> list[int]:
    """Return the horizons that are among those of each gap; short held-out episodes have no long ones."""
    return [horizon for horizon in of_each[0] if all(horizon in others for others in of_each)]


class Cost(Section):
    """Mean time of a stage for one seed."""

    wall_seconds: float
    cpu_seconds: float | None
    """Of all threads; None if not recorded."""


class Validity(Section):
    """Correlation between returns in a simulator and in the target, over policies (every row and seed)."""

    policies: int
    pearson: Correlation | None
    """None if undefined: fewer than three policies, or all with the same return."""
    spearman: Correlation | None


class Ranked(Section):
    """A policy as its judges see it, the simulators of other episodes."""

    row: str
    seed: int
    judges: int
    lower: float
    """Lower quartile of its success over the judges: what policies are ranked by."""
    predicted: float
    """Mean over the judges."""
    low: float | None
    """Ends of the 95 % interval of `predicted` over judges (Student's t); None with too few judges."""
    high: float | None
    target: float | None
    """Success in the target; None where it was not tested there."""


class Calibration(Section):
    """Predicted success less that in the target, over the seeds of a row."""

    seeds: int
    signed: float
    absolute: float


class Choice(Section):
    """A choice without the target; below `candidates`, what it is worth there, None until that is tested."""

    judge: str
    """The method whose groundings judge."""
    episodes: int
    """Of each policy with each judge."""
    shares_episodes: bool
    """Whether the judges were fitted to the same episodes as the policies."""
    candidates: list[Ranked]
    """Best first: the first is chosen."""
    rank_correlation: Correlation | None = None
    """With the target, within rows: Spearman's, a mean over rows; its interval resamples seeds."""
    regret: float | None = None
    """Success in the target of the best there, less that of the chosen."""
    random_regret: float | None = None
    """The same of one drawn at random, on average."""
    calibration: dict[str, Calibration] = Field(default_factory=dict)
    """By row."""
    withheld: dict[str, str] = Field(default_factory=dict)
    """Why a figure is None."""


class MethodResults(Section):
    """One row. Each measure is a list over seeds: its mean over the episodes in the target."""

    title: str
    role: str | None
    """"floor", "ceiling" or "trained there" (in the target), for the reference rows."""
    seeds: list[int]
    """Finished seeds."""
    success: list[float]
    failed: list[float]
    wall_contact: list[float]
    """Share of steps in contact with a wall."""
    steps: list[float]
    """Length of an episode in control steps."""
    returns: list[float] = Field(
        validation_alias=AliasChoices("return", "returns"), serialization_alias="return"
    )
    distance: list[NullableFloat]
    """Path length of the robot in successful episodes, in m; NaN for a seed without any."""
    simulated_success: list[float] | None
    """Success in the simulator that the policy was trained in; of a hand-written row, in the shared grounded
    one. None if there is none."""
    simulated_steps: list[float] | None = None
    """Length of an episode in that simulator, in control steps."""
    tries: list[float] | None = Field(default=None, exclude_if=lambda counts: counts is None)
    """Trainings that its policy took; None where each was trained once, whatever it reached."""
    beyond_recorded: list[float] | None = Field(default=None, exclude_if=lambda shares: shares is None)
    """Share of steps whose command is beyond the range of the row's dataset; None if that is not known."""
    simulator_returns: dict[str, list[float]]
    """Return in the shared test simulators, "raw" and "grounded", in which the row was tested."""
    encoders: dict[str, dict[str, list[float]]]
    """The same measures by encoder, for rows with more than one."""
    summary: dict[str, Summary] = Field(default_factory=dict)
    """Every measure over seeds; the distance over seeds that have one."""
    grounding: str | None
    """Name of the row's grounding folder, which rows may share."""
    gap: GapMeans | None
    learning: list[Learning]
    """Empty if the row is not trained."""
    cost: dict[str, Cost]
    """By stage; includes the grounding and alignment that it uses, though other rows may share them."""

    def measures(self) -> dict[str, list[float] | None]:
        """Return every measure over seeds by its name; None for one that the row does not have."""
        return {
            "success": self.success,
            "failed": self.failed,
            "wall_contact": self.wall_contact,
            "steps": self.steps,
            "return": self.returns,
            "simulated_success": self.simulated_success,
            "simulated_steps": self.simulated_steps,
            "distance": self.distance,
            "tries": self.tries,
            "beyond_recorded": self.beyond_recorded,
        }


class Results(Section):
    """All numbers on the page and in the figures."""

    format: Literal[1] = 1
    recipe: str
    task: str
    command: str
    """The command that produced these results."""
    scores: tuple[Score, ...] = (SUCCESS,)
    """Scores that the rows are compared by, the headline first."""
    settings: dict[str, JsonValue]
    """All settings of the recipe, with defaults filled in."""
    origins: list[Origin]
    """Normally one; more if code or machine changed between stages."""
    own_code: dict[str, str] = Field(default_factory=dict, exclude_if=lambda digests: not digests)
    """Digests of the user's code: "task", and methods by their names; empty where all is the package's."""
    wall_seconds: dict[str, float]
    """By stage, summed over all rows and seeds, and "total"; without stages that recorded no time."""
    cpu_seconds: dict[str, float]
    """The same for CPU time of all threads."""
    datasets: list[DatasetOrigin]
    evaluated_with: list[DatasetUse]
    seeds: list[int] = Field(default_factory=list)
    """Seeds that any row has finished."""
    episodes: int
    """Per row and seed."""
    tested_in: Literal["target", "simulators"] = Field(
        default="target", exclude_if=lambda place: place == "target"
    )
    """Where all rows were tested; a task may have no target."""
    leg_scale: float = 1.0
    """Leg length of the target's robot, relative to the one that collected the data."""
    stand_in: str | None = None
    """The simulator that stands in for a physical robot in the target, if any."""
    methods: dict[str, MethodResults]
    paper_success: dict[str, float] = Field(default_factory=dict)
    """Row → the success rate that the paper prints for it."""
    unfinished: list[str] = Field(default_factory=list)
    """Titles of the recipe's rows without a finished seed."""
    probability_of_improvement: dict[str, dict[str, Comparison]] = Field(default_factory=dict)
    """Compared row, ASTRA's by default → comparable row → how likely and by how much the first is better."""
    predictive_validity: dict[str, Validity] = Field(default_factory=dict)
    """By shared test simulator: "raw", and "grounded" if there is one."""
    choice: Choice | None = Field(default=None, exclude_if=lambda choice: choice is None)
    """None where `select` was not run."""
    throughput: dict[str, dict[str, dict[str, list[float]]]]
    """stage → figure → row, or grounding that rows share, or "all" → one value per seed."""

    @property
    def headline(self) -> Score:
        """The first of the scores."""
        return self.scores[0]

    def gaps(self) -> dict[str, GapMeans]:
        """Return each grounding's gap once, even if rows share it."""
        return {
            row.grounding: row.gap
            for row in self.methods.values()
            if row.grounding is not None and row.gap is not None
        }
