"""Results of a recipe: what results.json holds, as tidy tables of which all pages and figures are made."""

import json
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, JsonValue

from astra_data.core.arrays import Floats
from astra_data.core.config import read_written
from astra_data.core.errors import BadInputError
from astra_data.core.naming import reference_of
from astra_data.grounding.paired_episodes import BINS
from astra_data.methods import grounded_as, method_role, method_title
from astra_data.reports.artifacts import Machine, WrittenPart
from astra_data.reports.choice import Choice, Judgment, Trials, choice_of
from astra_data.reports.statistics import LEAST_SEEDS, Estimate, paired_difference, summarize
from astra_data.worlds.objective import SUCCESS, Score

if TYPE_CHECKING:
    import pandas as pd

WHOLE = 100  # the size of the dataset, in percent, of a recipe that does not sweep over sizes
TESTED, SIMULATED = "tested", "simulated"
"""Places: where a method was tested (the target, if there is one), and the simulator of its training."""
SHARES = ("success", "failed")  # measures that are shares of episodes
NullableFloat = Annotated[float, BeforeValidator(lambda value: float("nan") if value is None else value)]
"""A float whose NaN is null in JSON."""


class Facts(WrittenPart, extra="forbid"):
    """A part of the results, without unknown keys."""


class Origin(Facts):
    """Code, machine and packages that some stages, or the report, ran with; None or empty if not recorded."""

    commit: str | None
    machine: Machine | None
    packages: dict[str, str | None]
    stages: list[str]


class DatasetUse(Facts):
    """A dataset that a stage made, or that evaluations name (stage "evaluate")."""

    stage: str
    seed: int
    version: str
    content_hash: str
    name: str = ""


class OfSeed(Facts):
    """What belongs to a row, seed and size of the dataset; an empty row is for what all methods share."""

    row: str
    seed: int
    percent: int = WHOLE

    @property
    def key(self) -> tuple[Any, ...]:
        """What makes it unique: all of its names and whole numbers."""
        return tuple(value for name in type(self).model_fields if isinstance(value := getattr(self, name), str | int))


class Line(OfSeed):
    """What was measured of a method and seed in one place; NaN is left out."""

    where: str  # `TESTED`, `SIMULATED`, "raw" or "grounded" (test simulators), "encoder …", or a stage
    values: dict[str, float]


class Errors(OfSeed):
    """Open-loop error of a simulator on held-out episodes: its mean, and the ends of its 95 % interval."""

    simulator: str  # "grounded", "raw", or "still" for the persistence baseline, which predicts no motion
    quantity: str
    horizons: list[int]  # steps ahead, K of them
    mean: list[NullableFloat]
    low: list[NullableFloat]
    high: list[NullableFloat]


class TrainingFacts(OfSeed):
    """Learning curve: headline score of the training episodes that ended, from all start states."""

    steps: list[float]
    score: list[NullableFloat]


class Results(Facts):
    """All numbers on the page and in the figures."""

    recipe: str
    task: str
    command: str  # the commands that produced these results, a line each
    rows: tuple[str, ...]  # methods of the recipe, each alone or with `_plus`, in the order of the tables
    scores: tuple[Score, ...] = (SUCCESS,)  # scores that methods are compared by, the headline first
    compare: tuple[str, ...] = ("astra",)  # methods that are compared with the others
    episodes: int  # per method and seed
    tested_in: Literal["target", "simulators"] = "target"  # where all methods were tested; a task may have no target
    timestep_s: float | None = None  # of the task
    leg_scale: float = 1.0  # leg length of the target's robot, relative to the one that collected the data
    stand_in: str | None = None  # the simulator that stands in for a physical robot in the target, if any
    paper_success: dict[str, float] = Field(default_factory=dict)  # method → what the paper prints
    judged: Judgment | None = None  # the choice without the target; None where `select` was not run
    trials: Trials | None = None  # in the target, that end it; None where there were none
    settings: dict[str, JsonValue] = Field(default_factory=dict)  # all settings of the recipe, with defaults filled in
    origins: list[Origin] = Field(default_factory=list)  # normally one; more if code or machine changed between stages
    user_code: dict[str, str] = Field(default_factory=dict)  # digests: "task", and methods by name
    datasets: list[DatasetUse] = Field(default_factory=list)
    lines: list[Line] = Field(default_factory=list)
    errors: list[Errors] = Field(default_factory=list)
    trainings: list[TrainingFacts] = Field(default_factory=list)

    @property
    def headline(self) -> Score:
        """The first of the scores."""
        return self.scores[0]

    @cached_property
    def percents(self) -> list[int]:
        """The sizes of the dataset with a tested method or, without any, with a grounding, ascending."""
        tested = {line.percent for line in self.lines if line.where == TESTED}
        return sorted(tested or {error.percent for error in self.errors})

    @cached_property
    def seeds(self) -> list[int]:
        """The seeds that any method has finished."""
        return sorted({line.seed for line in self.lines if line.where == TESTED})

    @property
    def is_swept(self) -> bool:
        """Whether there are several sizes of the dataset."""
        return len(self.percents) > 1

    @property
    def largest(self) -> int:
        """The largest size of the dataset."""
        return (self.percents or [WHOLE])[-1]

    @property
    def sizes(self) -> list[JsonValue]:
        """The sizes of the dataset that the recipe sweeps over; empty where it does not."""
        sweep = self.settings.get("sweep")
        sizes = sweep.get("percent") if isinstance(sweep, dict) else None
        return sizes if isinstance(sizes, list) else []

    def tested(self, percent: int | None = None) -> list[str]:
        """Return the methods that are tested at a size, by default at any."""
        sizes = self.percents if percent is None else [percent]
        known = {line.row for line in self.lines if line.where == TESTED and line.percent in sizes}
        return [row for row in self.rows if row in known]

    def contenders(self) -> list[str]:
        """Return the methods tested at the largest size that are no references, on enough seeds where any is."""
        rows = [row for row in self.tested(self.largest) if not method_role(row)]
        seeds = {row: len(self.values(row, self.headline.measure)) for row in rows}
        least = min(LEAST_SEEDS, max(seeds.values(), default=0))
        return [row for row in rows if seeds[row] >= least]

    def values(self, row: str, measure: str, where: str = TESTED, percent: int | None = None) -> dict[int, float]:
        """Return the value of a measure by seed, at a size, by default the largest."""
        of = (row, percent or self.largest, where)
        lines = [line for line in self.lines if (line.row, line.percent, line.where) == of and measure in line.values]
        return {line.seed: line.values[measure] for line in sorted(lines, key=lambda line: line.seed)}

    def summary(self, row: str, measure: str, where: str = TESTED, percent: int | None = None) -> Estimate | None:
        """Return a measure over the seeds that have it; None where there are none."""
        values = self.values(row, measure, where, percent)
        return summarize([*values.values()], **self.bounds(measure)) if values else None

    def bounds(self, measure: str) -> dict[str, Any]:
        """Return `limit` and `trials` of a measure, as the statistics take them."""
        limits = {score.measure: score.limit for score in self.scores} | dict.fromkeys(SHARES, 1.0)
        return {"limit": limits.get(measure), "trials": self.episodes if measure in SHARES else 0}

    def score_of(self, row: str, where: str = TESTED, percent: int | None = None) -> Estimate | None:
        """Return the headline score of a method."""
        return self.summary(row, self.headline.measure, where, percent)

    def difference(self, row: str, other: str) -> Estimate | None:
        """Return by how much a method's headline score is higher, paired by seed."""
        measure = self.headline.measure
        return paired_difference(self.values(row, measure), self.values(other, measure), **self.bounds(measure))

    def groundings(self) -> list[str]:
        """Return the methods that ground a simulator, those of the tested methods first."""
        known = {one.row for one in self.errors}
        named = [name for row in self.rows if (name := grounded_as(row)) in known]
        return [*dict.fromkeys(named + sorted(known))]

    def mean_errors(self, percent: int | None = None) -> "pd.DataFrame":
        """Return mean, low, high by row, simulator, quantity, horizon, averaged over seeds, of shared horizons."""
        import pandas as pd

        index, values = ["row", "simulator", "quantity", "horizon"], ["mean", "low", "high"]
        errors = [one for one in self.errors if one.percent == (percent or self.largest)]
        lines = [(*e.key, *v) for e in errors for v in zip(e.horizons, e.mean, e.low, e.high, strict=True)]
        found = pd.DataFrame(lines, columns=["row", "seed", "percent", *index[1:], *values])
        if found.empty:
            return found.set_index(index)[values]
        per_fit = found[found["simulator"] == "grounded"].groupby(["row", "seed", "quantity"])["horizon"]
        kept = found[found["horizon"].isin(set.intersection(*(set(of) for _, of in per_fit)))]
        return kept.groupby(index, sort=False)[values].agg(lambda of: of.mean(skipna=False))

    def predicted_failures(self) -> "dict[tuple[int, str, str], pd.DataFrame]":
        """Return the figures of predicted failures by size, grounding and part of it: name → seed → value."""
        import pandas as pd

        found: dict[tuple[int, str, str], dict[int, dict[str, float]]] = {}
        for line in self.lines:
            for measure, value in line.values.items():
                if line.where == "ground" and measure.startswith("failures."):
                    _, part, name = measure.split(".", 2)
                    found.setdefault((line.percent, line.row, part), {}).setdefault(line.seed, {})[name] = value
        tables = {key: pd.DataFrame(of) for key, of in found.items()}
        return {key: of for key, of in tables.items() if of.index.str.startswith("auc").any()}

    def failure_rates(self) -> dict[str, dict[str, Floats]]:
        """Return what predicts failures → grounding → predicted and observed rate and number of steps, (3, bins)."""
        parts: dict[str, dict[str, Floats]] = {}
        for (percent, row, part), of in self.predicted_failures().items():
            rows = all_bins(of)
            if percent == self.largest and len(rows):
                bins = np.digitize(rows[:, 0], BINS[1:-1])
                pooled = [rows[bins == one] for one in np.unique(bins)]
                steps = np.array([of[:, 2].sum() for of in pooled])
                rates = np.array([of[:, :2].T @ of[:, 2] for of in pooled]).T / steps
                parts.setdefault(part.replace("_", " "), {})[row] = np.vstack([rates, steps])
        return parts

    def choice(self, percent: int | None = None) -> Choice | None:
        """Return the choice without the target at a size, and what it is worth there; None without one."""
        size = percent or self.largest
        if self.judged is None or size not in self.percents:
            return None
        rows = self.tested(size) if self.tested_in == "target" else []
        found = {row: self.values(row, "success", percent=size) for row in rows}
        target = {(row, seed): value for row, of in found.items() for seed, value in of.items()}
        return choice_of(self.judged, None if self.judged.percents == [None] else size, measured=target)

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
        place = (
            "Each method was tested in the simulator of its training: its own grounded one, or the raw one. So the "
            "numbers show what it learned, not whether it transfers. Add NAS to `methods` to test all of them in one "
            "simulator."
        )
        if reference:
            there = " and ".join(method_title(row) for row in self.rows if grounded_as(row) == reference)
            place = (
                f"All methods were tested in the abstract simulator grounded by {method_title(reference)}, in which "
                f"only {there} trained. It cannot show what is not in the abstract state."
            )
        return f"**Nothing was tested on a robot: the task has no target.** {place}"


def all_bins(of: "pd.DataFrame") -> Floats:
    """Return predicted and observed rates and number of steps of all bins and seeds, (N, 3)."""
    rows = of[of.index.str.startswith("reliability.")].to_numpy(dtype=float)
    stacked: Floats = rows.reshape(-1, 3, of.shape[1]).transpose(0, 2, 1).reshape(-1, 3)
    return stacked[~np.isnan(stacked).any(axis=1)]


def titled(row: str) -> str:
    """Return the title of a method, with what it is to the others: floor, ceiling or trained there."""
    role = method_role(row)
    return f"{method_title(row)} ({role})" if role else method_title(row)


def merge(sources: Sequence[Results]) -> Results:
    """Return the results of several places as one; a later line replaces one of the same method, seed and place."""
    last, judged = sources[-1], [one.judged for one in sources if one.judged]
    facts = {what: [getattr(one, what) for one in sources] for what in ("task", "episodes", "tested_in", "leg_scale")}
    facts["judges"] = [one.model_dump(exclude={"candidates"}) for one in judged]
    for what, values in facts.items():
        if any(value != values[0] for value in values):
            fault = f"expected all merged results to be made alike, got {what} {' and '.join(map(str, values))}"
            raise BadInputError(f"{last.recipe}: {fault}")
    parts = {
        part: [*{one.key: one for source in sources for one in getattr(source, part)}.values()]
        for part in ("lines", "errors", "trainings")
    }
    candidates = {(one.row, one.seed, one.percent): one for of in judged for one in of.candidates}
    code: dict[str, list[str]] = {}
    for name, digests in (item for one in sources for item in one.user_code.items()):
        code.setdefault(name, []).extend(digests.split(" and "))  # of code that changed in between
    return last.model_copy(
        update={
            "command": "\n".join(dict.fromkeys(line for one in sources for line in one.command.splitlines())),
            "rows": tuple(dict.fromkeys([*last.rows, *(row for one in sources for row in one.rows)])),
            "judged": judged[-1].model_copy(update={"candidates": [*candidates.values()]}) if judged else None,
            "trials": next((one.trials for one in reversed(sources) if one.trials), None),
            "origins": merged_origins(origin for one in sources for origin in one.origins),
            "user_code": {name: " and ".join(dict.fromkeys(of)) for name, of in code.items()},
            "datasets": _datasets(sources),
            **parts,
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
            got = f"those of {one.stage} seed {one.seed} with content {first.content_hash} and {one.content_hash}"
            fault = f"expected all merged results to use the same data, got {got}"
            advice = "processors round differently, so run all rows of a seed on one"
            raise BadInputError(f"{sources[-1].recipe}: {fault}: {advice}")
    return [*known.values()]


def merged_origins(origins: Iterable[Origin]) -> list[Origin]:
    """Return every code, machine and set of packages once, with all stages that ran there."""
    merged: dict[str, Origin] = {}
    for origin in origins:
        known = merged.setdefault(origin.model_dump_json(exclude={"stages"}), origin.model_copy(update={"stages": []}))
        known.stages.extend(stage for stage in origin.stages if stage not in known.stages)
    return list(merged.values())


def judged_horizon(horizons: Iterable[int]) -> int:
    """Return the steps ahead at which simulators are judged: the most of ten or less, if any are."""
    every = [*horizons]
    return max(horizon for horizon in every if horizon <= max(10, min(every)))


def elapsed_seconds(results: Results) -> float:
    """Return for how long anything ran, in s: the union of the times of all artifacts."""
    spans, total, last = [], 0.0, -np.inf
    for line in results.lines:
        seconds = line.values.get("wall_seconds", 0.0)
        if end := line.values.get("finished_at"):
            spans.append((end - seconds, end))
        else:
            total += seconds
    for begin, end in sorted(spans):
        total += max(0.0, end - max(begin, last))
        last = max(last, end)
    return float(total)


def stage_seconds(results: Results, clock: str) -> dict[str, float]:
    """Return the time of each stage over all of its artifacts, by "wall_seconds" or "cpu_seconds"."""
    known = [(line.where, line.values[clock]) for line in results.lines if clock in line.values]
    return {stage: sum(seconds for of, seconds in known if of == stage) for stage in dict(known)}


def read_results(path: Path) -> Results:
    """Read results from a JSON file; raise a BadInputError if it is missing, or no such file."""
    if not path.is_file():
        raise BadInputError(f"expected results in {path}, found none")
    return read_written(Results, path, by="the report", advice="remove it, or make it again")


def results_json(results: Results) -> str:
    """Return indented JSON in which each line of a table takes one line."""
    values = json.loads(results.model_dump_json())
    tables = {name: values.pop(name) for name in ("lines", "errors", "trainings")}
    text = json.dumps(values, indent=2, ensure_ascii=False).removesuffix("\n}")
    for name, lines in tables.items():
        each = ",\n".join(f"    {json.dumps(line, ensure_ascii=False)}" for line in lines)
        text += f',\n  "{name}": [\n{each}\n  ]'
    return f"{text}\n}}\n"
