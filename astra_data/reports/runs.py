"""Artifacts of all methods, seeds and sizes of a recipe → Results."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from math import isnan
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import JsonValue

from astra_data.core.config import read_written
from astra_data.core.errors import BadInputError, MissingStageError
from astra_data.core.naming import CODE, artifact_key, base_method
from astra_data.core.provenance import origin
from astra_data.dataset.format import DATASET_PATH
from astra_data.methods import grounded_as, method_named
from astra_data.reports import artifacts, results
from astra_data.reports.choice import FOLDER, SELECTED, TRIALS, Judged, Judgment, Trials
from astra_data.worlds.objective import SUCCESS, Score

DATASET_STAGES = ("collect", "label", "augment", "pair", "subset")  # they write a dataset of each seed
SHARED_WORLDS = ("raw", "grounded")  # simulators in which all methods are tested


def recorded_code(root: Path) -> dict[str, str]:
    """Return what the run at `root` recorded of the user's code and its settings; empty where it has none."""
    if not (root / CODE).is_file():
        return {}
    advice = "restore it from a copy, or remove it if the code is still what the run was made with"
    return read_written(dict[str, str], root / CODE, by="a run", advice=advice)


class Owner(NamedTuple):
    """Whose artifacts: a row (empty for datasets), a seed, and a size of the dataset if there are several."""

    row: str
    seed: int
    percent: int | None

    def facts(self) -> dict[str, Any]:
        """Return it as fields of `OfSeed`."""
        return self._asdict() | {"percent": results.WHOLE if self.percent is None else self.percent}


@dataclass(frozen=True)
class Selection:
    """Rows, seeds and sizes of a recipe; `percents` is empty where the recipe has no sizes."""

    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    percents: tuple[int, ...] = ()

    def points(self) -> dict[str, Owner]:
        """Return every row on every size of every seed, by the key of its evaluation, which is made last."""
        points = product(self.methods, self.percents or (None,), self.seeds)
        owners = [Owner(row, seed, percent) for row, percent, seed in points]
        return {artifact_key("evaluate", *owner): owner for owner in owners}


@dataclass(frozen=True, kw_only=True)
class Reported(Selection):
    """What stages of a whole recipe need of it, small enough to be sent to another process."""

    name: str
    task: str
    settings: Mapping[str, JsonValue]


class RunReader:
    """What is read of the artifacts at `root`, each once: the parts of Results."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self.origins: list[results.Origin] = []
        self.lines: list[results.Line] = []
        self.errors: list[results.Errors] = []

    def path(self, stage: str, owner: Owner, name: str) -> Path:
        """Return the place of an artifact's file."""
        return self._root / artifact_key(stage, *owner) / name

    def read[A: artifacts.Artifact](self, stage: str, owner: Owner, name: str, model: type[A]) -> A | None:
        """Read an artifact's file, and write down its origin and numbers; None where there is none."""
        file = artifacts.found_json(model, self.path(stage, owner, name))
        return file and self.add(stage, owner, file)

    def add[A: artifacts.Artifact](self, stage: str, owner: Owner, file: A) -> A:
        """Write down the origin and the numbers of a file."""
        made = {"commit": file.git_commit, "machine": file.machine, "packages": file.packages}
        self.origins.append(results.Origin.model_validate(made | {"stages": [stage]}))
        self._line(owner, stage, file.numbers())
        return file

    def _line(self, owner: Owner, where: str, values: Mapping[str, float | None]) -> None:
        if known := {name: float(one) for name, one in values.items() if one is not None and not isnan(one)}:
            self.lines.append(results.Line(**owner.facts(), where=where, values=known))

    def evaluation(self, owner: Owner) -> artifacts.Evaluation:
        """Read how a method was tested."""
        path = self.path("evaluate", owner, artifacts.EVALUATION)
        file = self.add("evaluate", owner, artifacts.read_json(artifacts.Evaluation, path))
        values: dict[str, float | None] = {**file.outcomes.means(), "beyond_recorded": file.beyond_recorded}
        trajectories = self.path("evaluate", owner, artifacts.TRAJECTORIES)
        if trajectories.is_file():
            values["distance"] = artifacts.way_to_success(trajectories, file)
        self._line(owner, results.TESTED, values)
        # A hand-written row has no simulator of its own.
        simulated = file.grounded if file.simulated is None and file.encoder is None else file.simulated
        for where, outcomes in {results.SIMULATED: simulated, "raw": file.raw, "grounded": file.grounded}.items():
            if outcomes is not None:
                self._line(owner, where, outcomes.means())
        for encoder, means in file.encoders.items():
            self._line(owner, f"encoder {encoder}", means)
        return file

    def grounding(self, owner: Owner) -> None:
        """Read times, R², predicted failures and open-loop errors on held-out episodes of a grounding."""
        self.read("ground", owner, artifacts.METRICS, artifacts.Metrics)
        gap = artifacts.found_json(artifacts.Gap, self.path("ground", owner, artifacts.GAP))
        if gap is None:
            return
        for simulator, of in {"still": gap.still or {}, "raw": gap.raw, "grounded": gap.grounded}.items():
            for quantity, band in of.items():
                given: dict[str, Any] = {"simulator": simulator, "quantity": quantity, "horizons": gap.horizons}
                self.errors.append(results.Errors(**owner.facts(), **given, **band.model_dump()))


def read_run(
    reported: Reported, *, root: Path, command: str, scores: tuple[Score, ...] = (SUCCESS,), **facts: object
) -> results.Results:
    """Return the results under `root` of every method, for the seeds that it has finished; `facts` are of `Results`."""
    rows, seeds, run = reported.methods, reported.seeds, RunReader(root)
    files: list[artifacts.Evaluation] = []
    trainings: list[results.TrainingFacts] = []
    for percent in reported.percents or (None,):
        owners = [Owner(row, seed, percent) for row in rows for seed in seeds]
        finished = [owner for owner in owners if run.path("evaluate", owner, artifacts.EVALUATION).is_file()]
        files += map(run.evaluation, finished)
        # Fine-tuned policies start from those of a method that need not be reported.
        initial = [(method_named(owner.row).initial, owner) for owner in finished]
        for owner in dict.fromkeys([*finished, *(owner._replace(row=row) for row, owner in initial if row)]):
            curve = run.read("train", owner, artifacts.CURVE, artifacts.CurveFile)
            if curve and owner in finished:
                steps = [point.steps for point in curve.points]
                kept = {"success": "success", "steps": "episode_steps"}.get(scores[0].measure, "")
                found = [getattr(point, kept, None) for point in curve.points]  # others are not kept
                trainings.append(results.TrainingFacts.model_validate(owner.facts() | {"steps": steps, "score": found}))
        for owner in dict.fromkeys(owner._replace(row=grounded_as(owner.row)) for owner in finished):
            run.grounding(owner)
            run.read("align", owner, artifacts.METRICS, artifacts.Metrics)
    uses = []
    for stage in DATASET_STAGES:
        percents = reported.percents if stage == "subset" else (None,)
        for owner in (Owner("", seed, percent) for seed in seeds for percent in percents):
            data = run.read(stage, owner, str(DATASET_PATH), artifacts.DatasetFile)
            if data and owner.percent is None:
                identity = data.model_dump(include={"name", "version", "content_hash"})
                uses.append(results.DatasetUse(stage=stage, seed=owner.seed, **identity))
    for file in files:
        if file.dataset_hash:
            version, content = file.dataset_version or "", file.dataset_hash
            uses.append(results.DatasetUse(stage="evaluate", seed=file.seed, version=version, content_hash=content))
    judgment = trials = None
    if judged := artifacts.found_json(Judged, root / FOLDER / SELECTED):
        run.add("select", Owner("", seeds[0], None), judged)
        if known := [one for one in judged.candidates if one.row in rows and one.seed in seeds]:
            facts_of = judged.model_dump(include={"judge", "episodes", "shares_episodes"})
            judgment = Judgment(**facts_of, candidates=known)
            if begun := artifacts.found_json(Trials, root / FOLDER / TRIALS):
                tried = {key for round_ in begun.rounds for key in round_.candidates}
                trials = begun if tried <= {(one.row, one.seed) for one in known} else None
    run.add("report", Owner("", 0, None), artifacts.Artifact.model_validate(origin()))
    if not files:
        raise MissingStageError(
            f"expected {artifacts.EVALUATION} in {root / 'evaluate'}/<method>/seed_<seed>/, found none for "
            f"{', '.join(rows)}; run the recipe {reported.name} again: it continues with what is missing"
        )
    first = files[0]
    if wrong := [
        f"{file.method} seed {file.seed} on {file.task} with {file.episodes} episodes and legs {file.leg_scale:g} "
        "times as long"
        for file in files
        if (file.task, file.episodes, file.leg_scale) != (reported.task, first.episodes, first.leg_scale)
    ]:
        raise BadInputError(
            f"expected every method evaluated on {reported.task} with {first.episodes} episodes and legs "
            f"{first.leg_scale:g} times as long, got {', '.join(wrong)}; evaluate those again"
        )
    code = ["task", *(name for row in rows for name in (base_method(row), grounded_as(row)))]
    recorded = recorded_code(root)
    made = {
        "recipe": reported.name,
        "task": reported.task,
        "command": command,
        "rows": rows,
        "scores": scores,
        "episodes": first.episodes,
        "tested_in": "target" if all(file.target for file in files) else "simulators",
        "leg_scale": first.leg_scale,
        "settings": dict(reported.settings),
        "origins": results.merged_origins(run.origins),
        "user_code": {name: recorded[name] for name in dict.fromkeys(code) if name in recorded},
        "judged": judgment,
        "trials": trials,
        "datasets": [*dict.fromkeys(uses)],
        "lines": run.lines,
        "errors": run.errors,
        "trainings": trainings,
    }
    return results.Results.model_validate(made | facts)
