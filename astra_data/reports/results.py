"""Results of a recipe: what results.json holds, as tidy tables.

`lines` holds every number that is measured once per method, seed, size of the dataset and place, `errors`
those that have a horizon, too. Both are one `pandas` table each (`table`, `error_table`); all pages and
figures are made of these. Results of several places are merged line by line.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, JsonValue, ValidationError

from astra_data.core.config import faults_of
from astra_data.core.errors import BadInputError
from astra_data.core.naming import reference_of
from astra_data.methods import grounded_as, method_role, method_title
from astra_data.reports.artifacts import Machine
from astra_data.reports.choice import Candidate, Choice, Judged, choice_of
from astra_data.reports.statistics import Estimate, Summary, paired_difference, summarize
from astra_data.worlds.objective import SUCCESS, Score

if TYPE_CHECKING:
    import pandas as pd

WHOLE = 100
"""The size of the dataset, in percent, of a recipe that does not sweep over sizes."""
TESTED, SIMULATED, JUDGED = "tested", "simulated", "judged"
"""Places: where a method was tested (the target, if there is one); the simulator of its training; its
judges."""
SHARES = ("success", "failed")
"""Measures that are shares of episodes."""

NullableFloat = Annotated[float, BeforeValidator(lambda value: float("nan") if value is None else value)]
"""A float whose NaN is null in JSON."""


class Facts(BaseModel):
    """A part of the results; frozen, without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Origin(Facts):
    """Code, machine and packages that some stages ran with; None or empty where not recorded."""

    commit: str | None
    """Ends in "-dirty" if there were uncommitted changes."""
    machine: Machine | None
    packages: dict[str, str | None]
    stages: list[str]
    """Names of those stages; "report" is the report itself."""


class DatasetUse(Facts):
    """A dataset that a stage made, or that evaluations name (stage "evaluate")."""

    stage: str
    seed: int
    version: str
    content_hash: str
    name: str = ""


class Line(Facts):
    """What was measured of a method and seed in one place; NaN is left out."""

    row: str
    """Empty for what all methods share, such as datasets; groundings are of the method that fits them."""
    seed: int
    percent: int = WHOLE
    where: str
    """`TESTED`, `SIMULATED`, "raw" or "grounded" (test simulators), "encoder …", `JUDGED`, or a stage."""
    values: dict[str, float]

    @property
    def key(self) -> tuple[str, int, int, str]:
        """What makes it unique."""
        return (self.row, self.seed, self.percent, self.where)


class Errors(Facts):
    """Open-loop error of a simulator on held-out episodes: its mean, and the ends of its 95 % interval."""

    row: str
    """The method that grounds."""
    seed: int
    percent: int = WHOLE
    simulator: str
    """"grounded", "raw", or "still" for the persistence baseline, which predicts no motion."""
    quantity: str
    horizons: list[int]
    """Steps ahead, K of them."""
    mean: list[NullableFloat]
    low: list[NullableFloat]
    high: list[NullableFloat]

    @property
    def key(self) -> tuple[str, int, int, str, str]:
        """What makes it unique."""
        return (self.row, self.seed, self.percent, self.simulator, self.quantity)


class TrainingFacts(Facts):
    """Learning curve of a method and seed."""

    row: str
    seed: int
    percent: int = WHOLE
    steps: list[float]
    score: list[NullableFloat]
    """Headline score of the training episodes that ended, from all start states."""

    @property
    def key(self) -> tuple[str, int, int]:
        """What makes it unique."""
        return (self.row, self.seed, self.percent)


class JudgeFacts(Facts):
    """Who judged in the choice without the target."""

    judge: str
    """The method whose groundings judge."""
    episodes: int
    """Of each policy with each judge."""
    shares_episodes: bool
    """Whether the judges were fitted to the same episodes as the policies."""


class Results(Facts):
    """All numbers on the page and in the figures."""

    format: Literal[2] = 2
    recipe: str
    task: str
    command: str
    """The command that produced these results."""
    rows: tuple[str, ...]
    """Methods of the recipe, each alone or with `_plus`, in the order of the tables."""
    scores: tuple[Score, ...] = (SUCCESS,)
    """Scores that methods are compared by, the headline first."""
    compare: tuple[str, ...] = ("astra",)
    """Methods that are compared with the others."""
    episodes: int
    """Per method and seed."""
    tested_in: Literal["target", "simulators"] = "target"
    """Where all methods were tested; a task may have no target."""
    timestep_s: float | None = None
    """Of the task."""
    leg_scale: float = 1.0
    """Leg length of the target's robot, relative to the one that collected the data."""
    stand_in: str | None = None
    """The simulator that stands in for a physical robot in the target, if any."""
    paper_success: dict[str, float] = Field(default_factory=dict)
    """Method → the success rate that the paper prints for it."""
    judges: JudgeFacts | None = None
    """None where `select` was not run."""
    settings: dict[str, JsonValue] = Field(default_factory=dict)
    """All settings of the recipe, with defaults filled in."""
    origins: list[Origin] = Field(default_factory=list)
    """Normally one; more if code or machine changed between stages."""
    user_code: dict[str, str] = Field(default_factory=dict)
    """Digests of the user's code: "task", and methods by their names."""
    datasets: list[DatasetUse] = Field(default_factory=list)
    lines: list[Line] = Field(default_factory=list)
    errors: list[Errors] = Field(default_factory=list)
    trainings: list[TrainingFacts] = Field(default_factory=list)

    @property
    def headline(self) -> Score:
        """The first of the scores."""
        return self.scores[0]

    @cached_property
    def table(self) -> "pd.DataFrame":
        """Return a line for each number: row, seed, percent, where, measure, value."""
        import pandas as pd

        return pd.DataFrame(
            [(*line.key, measure, value) for line in self.lines for measure, value in line.values.items()],
            columns=["row", "seed", "percent", "where", "measure", "value"],
        )

    @cached_property
    def error_table(self) -> "pd.DataFrame":
        """Return a line for each error: row, seed, percent, simulator, quantity, horizon, mean, low, high."""
        import pandas as pd

        return pd.DataFrame(
            [
                (*one.key, *values)
                for one in self.errors
                for values in zip(one.horizons, one.mean, one.low, one.high, strict=True)
            ],
            columns=[
                *("row", "seed", "percent", "simulator", "quantity"),
                *("horizon", "mean", "low", "high"),
            ],
        )

    @cached_property
    def percents(self) -> list[int]:
        """The sizes of the dataset with a tested method or, without any, with a grounding, ascending."""
        tested = {line.percent for line in self.lines if line.where == TESTED}
        return sorted(tested or {error.percent for error in self.errors})

    @cached_property
    def seeds(self) -> list[int]:
        """The seeds that any method has finished."""
        return sorted({line.seed for line in self.lines if line.where == TESTED})

    def tested(self, percent: int | None = None) -> list[str]:
        """Return the methods that are tested at a size, by default at any."""
        sizes = self.percents if percent is None else [percent]
        known = {line.row for line in self.lines if line.where == TESTED and line.percent in sizes}
        return [row for row in self.rows if row in known]

    def values(
        self, row: str, measure: str, where: str = TESTED, percent: int | None = None
    ) -> dict[int, float]:
        """Return the value of a measure by seed, at a size, by default the largest."""
        return self._values.get((row, self._size(percent), where, measure), {})

    @cached_property
    def _values(self) -> dict[tuple[str, int, str, str], dict[int, float]]:
        found: dict[tuple[str, int, str, str], dict[int, float]] = {}
        for line in self.lines:
            for measure, value in line.values.items():
                found.setdefault((line.row, line.percent, line.where, measure), {})[line.seed] = value
        return {key: dict(sorted(of_seeds.items())) for key, of_seeds in found.items()}

    def _size(self, percent: int | None) -> int:
        return percent if percent is not None else (self.percents or [WHOLE])[-1]

    def summary(
        self, row: str, measure: str, where: str = TESTED, percent: int | None = None
    ) -> Summary | None:
        """Return a measure over the seeds that have it; None where there are none."""
        values = self.values(row, measure, where, percent)
        limit, trials = self._bounds(measure)
        return summarize([*values.values()], limit=limit, trials=trials) if values else None

    def _bounds(self, measure: str) -> tuple[float | None, int]:
        """Return `limit` and `trials` of a measure, as the statistics take them."""
        limits = {score.measure: score.limit for score in self.scores} | dict.fromkeys(SHARES, 1.0)
        return limits.get(measure), self.episodes if measure in SHARES else 0

    def score_of(self, row: str, where: str = TESTED, percent: int | None = None) -> Summary | None:
        """Return the headline score of a method."""
        return self.summary(row, self.headline.measure, where, percent)

    def difference(self, row: str, other: str, percent: int | None = None) -> Estimate | None:
        """Return by how much a method's headline score is higher, paired by seed."""
        sides = (self.values(one, self.headline.measure, TESTED, percent) for one in (row, other))
        limit, trials = self._bounds(self.headline.measure)
        return paired_difference(*sides, limit=limit, trials=trials)

    def groundings(self) -> list[str]:
        """Return the methods that ground a simulator, those of the tested methods first."""
        known = {one.row for one in self.errors}
        return [
            *dict.fromkeys([name for row in self.rows if (name := grounded_as(row)) in known] + sorted(known))
        ]

    def mean_errors(self, percent: int | None = None) -> "pd.DataFrame":
        """Return errors averaged over seeds, of the horizons that all seeds and groundings share.

        The index is row, simulator, quantity, horizon; the columns are mean, low, high; NaN where a seed has
        none.
        """
        found = self.error_table
        found = found[found["percent"] == self._size(percent)]
        if found.empty:
            return found.set_index(["row", "simulator", "quantity", "horizon"])[["mean", "low", "high"]]
        per_fit = found[found["simulator"] == "grounded"].groupby(["row", "seed", "quantity"])["horizon"]
        shared = set.intersection(*(set(of) for _, of in per_fit))
        kept = found[found["horizon"].isin(shared)]
        groups = kept.groupby(["row", "simulator", "quantity", "horizon"], sort=False)
        return groups[["mean", "low", "high"]].agg(lambda values: values.mean(skipna=False))

    def judged(self) -> Judged | None:
        """Return the candidates of the choice without the target; None where there are none."""
        if self.judges is None:
            return None
        candidates = [
            Candidate(
                row=line.row,
                seed=line.seed,
                percent=line.percent,
                success={int(judge): value for judge, value in line.values.items()},
            )
            for line in self.lines
            if line.where == JUDGED
        ]
        return Judged(candidates=candidates, **self.judges.model_dump()) if candidates else None

    def choice(self, percent: int | None = None) -> Choice | None:
        """Return the choice without the target at a size, and what it is worth there; None without one."""
        return self._choices.get(self._size(percent))

    @cached_property
    def _choices(self) -> dict[int, Choice]:
        judged, found = self.judged(), {}
        for size in self.percents if judged else ():
            target = {
                (line.row, line.seed): line.values["success"]
                for line in self.lines
                if line.where == TESTED and line.percent == size and self.tested_in == "target"
            }
            if judged and (choice := choice_of(judged, size, measured=target)):
                found[size] = choice
        return found

    @property
    def where(self) -> str:
        """The words for where methods were tested, which follow a score."""
        if self.tested_in == "target":
            return "in the target"
        reference = reference_of(self.rows)
        return f"in the simulator grounded by {method_title(reference)}" if reference else "in a simulator"

    @property
    def warning(self) -> str:
        """What is to be known before all else of results that are of no target; empty for others."""
        if self.tested_in == "target":
            return ""
        reference = reference_of(self.rows)
        if reference is None:
            place = (
                "Each method was tested in the simulator of its training: its own grounded one, or the raw "
                "one. So the numbers show what it learned, not whether it transfers. Add NAS to `methods` "
                "to test all of them in one simulator."
            )
        else:
            there = [method_title(row) for row in self.rows if grounded_as(row) == reference]
            place = (
                f"All methods were tested in the abstract simulator grounded by {method_title(reference)}, "
                f"in which only {' and '.join(there)} trained. It cannot show what is not in the abstract "
                "state."
            )
        return f"**Nothing was tested on a robot: the task has no target.** {place}"


def titled(row: str) -> str:
    """Return the title of a method, with what it is to the others: floor, ceiling or trained there."""
    role = method_role(row)
    return f"{method_title(row)} ({role})" if role else method_title(row)


def contenders(results: Results, percent: int | None = None) -> list[str]:
    """Return the tested methods that are no references."""
    return [row for row in results.tested(percent) if not method_role(row)]


def merge(sources: Sequence[Results]) -> Results:
    """Return the results of several places as one, without losing any; facts are those of the last.

    A later line replaces an earlier one of the same method, seed and place.

    Raises:
        BadInputError: the sources differ in task, episodes, robot or data.
    """
    last = sources[-1]
    for what in ("task", "episodes", "tested_in", "leg_scale", "judges"):
        known = list(dict.fromkeys(value for one in sources if (value := getattr(one, what)) is not None))
        if len(known) > 1:
            raise BadInputError(
                f"{last.recipe}: expected all merged results to be made alike, got {what} "
                f"{' and '.join(map(str, known))}"
            )
    rows = dict.fromkeys([*last.rows, *(row for one in sources for row in one.rows)])
    return last.model_copy(
        update={
            "rows": tuple(rows),
            "judges": next((one.judges for one in reversed(sources) if one.judges), None),
            "origins": merged_origins(origin for one in sources for origin in one.origins),
            "user_code": {name: digest for one in sources for name, digest in one.user_code.items()},
            "datasets": _datasets(sources),
            "lines": [*{line.key: line for one in sources for line in one.lines}.values()],
            "errors": [*{error.key: error for one in sources for error in one.errors}.values()],
            "trainings": [*{curve.key: curve for one in sources for curve in one.trainings}.values()],
        }
    )


def replaced(earlier: Results, later: Results) -> list[str]:
    """Return, in words, the tested methods and seeds of `earlier` whose score is another in `later`."""
    measure = earlier.headline.measure
    now = {line.key: line.values.get(measure) for line in later.lines if line.where == TESTED}
    return [
        f"{line.row} seed {line.seed}{'' if line.percent == WHOLE else f' at {line.percent} %'} "
        f"({measure} {line.values[measure]:.4g}, now {now[line.key]:.4g})"
        for line in earlier.lines
        if line.where == TESTED and now.get(line.key, line.values[measure]) != line.values[measure]
    ]


def _datasets(sources: Sequence[Results]) -> list[DatasetUse]:
    known: dict[tuple[str, int, str], DatasetUse] = {}
    for one in (dataset for source in sources for dataset in source.datasets):
        # Methods may be tested with different datasets; what a stage made of a seed is one.
        content = one.content_hash if one.stage == "evaluate" else ""
        first = known.setdefault((one.stage, one.seed, content), one)
        if first.content_hash != one.content_hash:
            raise BadInputError(
                f"{sources[-1].recipe}: expected all merged results to use the same data, got those of "
                f"{one.stage} seed {one.seed} with content {first.content_hash} and {one.content_hash}"
            )
    return [*known.values()]


def merged_origins(origins: Iterable[Origin]) -> list[Origin]:
    """Return every code, machine and set of packages once, with all stages that ran there."""
    merged: dict[str, Origin] = {}
    for origin in origins:
        key = origin.model_dump_json(exclude={"stages"})
        known = merged.get(key, origin)
        stages = list(dict.fromkeys([*known.stages, *origin.stages]))
        merged[key] = known.model_copy(update={"stages": stages})
    return list(merged.values())


def judged_horizon(horizons: Iterable[int]) -> int:
    """Return the steps ahead at which simulators are judged: the most of ten or less, if any are."""
    every = [*horizons]
    return max(horizon for horizon in every if horizon <= max(10, min(every)))


def elapsed_seconds(results: Results) -> float:
    """Return for how long anything ran, in s: the union of the times of all artifacts.

    What ran at the same time counts once. An artifact without a time of its end, such as one of an older
    version, counts as if nothing ran beside it.
    """
    spans, alone = [], 0.0
    for line in results.lines:
        seconds, end = line.values.get("wall_seconds", 0.0), line.values.get("finished_at")
        if end is None:
            alone += seconds
        else:
            spans.append((end - seconds, end))
    total, last = alone, -np.inf
    for begin, end in sorted(spans):
        total += max(0.0, end - max(begin, last))
        last = max(last, end)
    return float(total)


def stage_seconds(results: Results, clock: str) -> dict[str, float]:
    """Return the time of each stage over all of its artifacts, by "wall_seconds" or "cpu_seconds"."""
    times: dict[str, float] = {}
    for line in results.lines:
        if clock in line.values:
            times[line.where] = times.get(line.where, 0.0) + line.values[clock]
    return times


def read_results(path: Path) -> Results:
    """Read results from a JSON file.

    Raises:
        BadInputError: the file is missing, or has another layout.
    """
    if not path.is_file():
        raise BadInputError(f"expected results in {path}, found none")
    try:
        return Results.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise BadInputError(
            f"{path} does not hold results in the current format: {faults_of(error)}: remove it, or make it "
            "again"
        ) from None


def results_json(results: Results) -> str:
    """Return indented JSON in which a list of numbers, and each line of a table, takes one line."""
    values = json.loads(results.model_dump_json())
    tables = {name: values.pop(name) for name in ("lines", "errors", "trainings")}
    text = json.dumps(values, indent=2, ensure_ascii=False)
    text = re.sub(r"\[\n[^\[\]{}]*\]", lambda found: re.sub(r"\n *", " ", found[0]), text)
    for name, lines in tables.items():
        each = ",\n".join(f"    {json.dumps(line, ensure_ascii=False)}" for line in lines)
        listed = f"[\n{each}\n  ]" if lines else "[]"
        text = f'{text[:-2]},\n  "{name}": {listed}\n}}'
    return text + "\n"


def without_nan(values: Mapping[str, float | None]) -> dict[str, float]:
    """Return the values that are numbers."""
    return {name: float(value) for name, value in values.items() if value is not None and not np.isnan(value)}
