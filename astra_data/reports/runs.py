"""Artifacts of all methods, seeds and sizes of a recipe → Results."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import JsonValue

from astra_data.core.config import read_written
from astra_data.core.errors import BadInputError, MissingStageError
from astra_data.core.naming import CODE, artifact_key, base_method
from astra_data.core.provenance import origin
from astra_data.dataset.format import DATASET_PATH
from astra_data.methods import grounded_as, method_named
from astra_data.reports.artifacts import (
    CURVE,
    EVALUATION,
    GAP,
    METRICS,
    TRAJECTORIES,
    Artifact,
    CurveFile,
    DatasetFile,
    Evaluation,
    Gap,
    Metrics,
    read_json,
    way_to_success,
)
from astra_data.reports.choice import read_judged
from astra_data.reports.results import (
    JUDGED,
    SIMULATED,
    TESTED,
    WHOLE,
    DatasetUse,
    Errors,
    JudgeFacts,
    Line,
    Origin,
    Results,
    TrainingFacts,
    merged_origins,
    without_nan,
)
from astra_data.worlds.objective import SUCCESS, Score

DATASET_STAGES = ("collect", "label", "augment", "pair", "subset")
"""Stages that write a dataset of each seed, in their order."""
SHARED_WORLDS = ("raw", "grounded")
"""Simulators in which all methods are tested."""
_TIMES = ("wall_seconds", "cpu_seconds", "finished_at")
_SPEEDS = (
    *("target_steps_per_second", "pairs_per_second"),
    *("windows_per_second", "episodes_per_second", "replays_per_second"),
    *("simulator_steps_per_second", "steps_per_second", "updates_per_second"),
)
"""Names under which stages record their speed."""


@dataclass(frozen=True, kw_only=True)
class Reported:
    """What stages of a whole recipe need of it, small enough to be sent to another process.

    Attributes:
        name: of the recipe's file, without its ending. task: as `task_named` takes it.
        methods: rows, in the order of the table. seeds: those to report, as far as they are finished.
        settings: all settings of the recipe.
        percents: dataset sizes in percent that every row is repeated on; empty if only on the whole.
    """

    name: str
    task: str
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    settings: Mapping[str, JsonValue]
    percents: tuple[int, ...] = ()


def recorded_code(root: Path) -> dict[str, str]:
    """Return what the run at `root` recorded of the user's code and its settings; empty where it has none.

    Raises:
        BadInputError: the record is damaged.
    """
    if not (root / CODE).is_file():
        return {}
    advice = "restore it from a copy, or remove it if the code is still what the run was made with"
    return read_written(dict[str, str], root / CODE, by="a run", advice=advice)


def read_run(
    reported: Reported,
    *,
    root: Path,
    command: str,
    scores: tuple[Score, ...] = (SUCCESS,),
    **facts: object,
) -> Results:
    """Return the results under `root` of every method, for the seeds that it has finished.

    Args:
        reported: whose they are; its task by its name, as in its evaluations.
        root: its folder of runs: `root`/<stage>/<method>/seed_<seed>/.
        command: that made them.
        scores: that methods are compared by.
        facts: further fields of `Results`.

    Raises:
        MissingStageError: no method has an evaluation.
        BadInputError: an artifact is malformed, or methods differ in task, episodes, robot or quantities.
    """
    run = _Run(reported, root, scores[0])
    run.read()
    files = run.evaluations
    if not files:
        raise MissingStageError(
            f"expected {EVALUATION} in {root / 'evaluate'}/<method>/seed_<seed>/, found none for "
            f"{', '.join(reported.methods)}; run the recipe {reported.name} again: it continues with what is "
            "missing"
        )
    _check_alike(files, reported.task)
    uses = [
        DatasetUse(
            stage="evaluate",
            seed=file.seed,
            version=file.dataset_version or "",
            content_hash=file.dataset_hash,
        )
        for file in files
        if file.dataset_hash
    ]
    judged = run.judged
    return Results.model_validate(
        {
            "recipe": reported.name,
            "task": reported.task,
            "command": command,
            "rows": reported.methods,
            "scores": scores,
            "episodes": files[0].episodes,
            "tested_in": "target" if all(file.target for file in files) else "simulators",
            "leg_scale": files[0].leg_scale,
            "settings": dict(reported.settings),
            "origins": run.origins(),
            "user_code": _code_of(root, reported.methods),
            "judges": judged
            and JudgeFacts(
                judge=judged.judge, episodes=judged.episodes, shares_episodes=judged.shares_episodes
            ),
            "datasets": [*run.datasets, *dict.fromkeys(uses)],
            "lines": run.lines,
            "errors": run.errors,
            "trainings": run.trainings,
            **facts,
        }
    )


def _code_of(root: Path, rows: Iterable[str]) -> dict[str, str]:
    """Return the digests that the run recorded of the code of its task and of methods of `rows`."""
    recorded = recorded_code(root)
    named = ["task", *(name for row in rows for name in (base_method(row), grounded_as(row)))]
    return {name: recorded[name] for name in dict.fromkeys(named) if name in recorded}


def _check_alike(files: Sequence[Evaluation], task: str) -> None:
    """Refuse evaluations that cannot stand in one table."""
    first = files[0]
    wrong = [
        f"{file.method} seed {file.seed} on {file.task} with {file.episodes} episodes and legs "
        f"{file.leg_scale:g} times as long"
        for file in files
        if (file.task, file.episodes, file.leg_scale) != (task, first.episodes, first.leg_scale)
    ]
    if wrong:
        raise BadInputError(
            f"expected every method evaluated on {task} with {first.episodes} episodes and legs "
            f"{first.leg_scale:g} times as long, got {', '.join(wrong)}; evaluate those again"
        )


class _Run:
    """Reads the artifacts of a run, each once."""

    def __init__(self, reported: Reported, root: Path, score: Score) -> None:
        if not reported.methods or not reported.seeds:
            raise BadInputError(
                f"{reported.name}: expected methods and seeds, got none; name some in the recipe"
            )
        self._reported, self._root, self._score = reported, root, score
        self._made: dict[str, list[Artifact]] = {}
        self.evaluations: list[Evaluation] = []
        self.judged = read_judged(root)
        self.datasets: list[DatasetUse] = []
        self.lines: list[Line] = []
        self.errors: list[Errors] = []
        self.trainings: list[TrainingFacts] = []

    def read(self) -> None:
        """Read all that is there."""
        for percent in self._reported.percents or (None,):
            finished = [
                (row, seed)
                for row in self._reported.methods
                for seed in self._reported.seeds
                if self._path("evaluate", row, seed, percent, EVALUATION).is_file()
            ]
            for row, seed in finished:
                self._evaluation(row, seed, percent)
            trained = dict.fromkeys(finished)
            # Fine-tuned policies start from those of a method that need not be reported.
            trained |= {(first, seed): None for row, seed in finished if (first := method_named(row).initial)}
            for row, seed in trained:
                self._training(row, seed, percent, is_shown=(row, seed) in finished)
            for row, seed in dict.fromkeys((grounded_as(row), seed) for row, seed in finished):
                self._grounding(row, seed, percent)
                self._file("align", row, seed, percent, METRICS, Metrics)
        self._of_datasets()
        self._choice()

    def _path(self, stage: str, row: str, seed: int, percent: int | None, name: str) -> Path:
        return self._root / artifact_key(stage, row, seed, percent) / name

    def _file[A: Artifact](
        self, stage: str, row: str, seed: int, percent: int | None, name: str, model: type[A], **more: float
    ) -> A | None:
        """Read an artifact's file, and write down its times and speeds; None where there is none."""
        path = self._path(stage, row, seed, percent, name)
        if not path.is_file():
            return None
        file = read_json(model, path)
        self._add(stage, row, seed, percent, file, more)
        return file

    def _add(
        self,
        stage: str,
        row: str,
        seed: int,
        percent: int | None,
        file: Artifact,
        more: Mapping[str, float | None] = {},
    ) -> None:
        times = {name: getattr(file, name, None) for name in (*_TIMES, *_SPEEDS)}
        self._made.setdefault(stage, []).append(file)
        self._line(row, seed, percent, stage, {**times, **more})

    def _line(
        self, row: str, seed: int, percent: int | None, where: str, values: Mapping[str, float | None]
    ) -> None:
        known = without_nan(values)
        if known:
            size = WHOLE if percent is None else percent
            self.lines.append(Line(row=row, seed=seed, percent=size, where=where, values=known))

    def _evaluation(self, row: str, seed: int, percent: int | None) -> None:
        file = self._file("evaluate", row, seed, percent, EVALUATION, Evaluation)
        assert file is not None
        self.evaluations.append(file)
        values: dict[str, float | None] = {
            **file.outcomes.means(),
            "beyond_recorded": file.beyond_recorded,
        }
        trajectories = self._path("evaluate", row, seed, percent, TRAJECTORIES)
        if trajectories.is_file():
            values["distance"] = way_to_success(trajectories, file)
        self._line(row, seed, percent, TESTED, values)
        simulated = file.simulated
        if simulated is None and file.encoder is None:
            simulated = file.grounded  # a hand-written row has no simulator of its own
        worlds = {SIMULATED: simulated, **{world: getattr(file, world) for world in SHARED_WORLDS}}
        for where, outcomes in worlds.items():
            if outcomes is not None:
                self._line(row, seed, percent, where, outcomes.means())
        for encoder, means in file.encoders.items():
            self._line(row, seed, percent, f"encoder {encoder}", means)

    def _training(self, row: str, seed: int, percent: int | None, *, is_shown: bool) -> None:
        path = self._path("train", row, seed, percent, CURVE)
        if not path.is_file():
            return
        file = read_json(CurveFile, path)
        self._add("train", row, seed, percent, file, {"tries": float(len(file.tries)) or None})
        scores = [point.success if self._score == SUCCESS else point.episode_steps for point in file.points]
        if is_shown:
            self.trainings.append(
                TrainingFacts.model_validate(
                    {
                        "row": row,
                        "seed": seed,
                        "percent": WHOLE if percent is None else percent,
                        "steps": [point.steps for point in file.points],
                        "score": scores,
                    }
                )
            )

    def _grounding(self, row: str, seed: int, percent: int | None) -> None:
        self.lines += read_grounding(self._root, row, seed, percent)
        path = self._path("ground", row, seed, percent, METRICS)
        if path.is_file():
            self._made.setdefault("ground", []).append(read_json(Metrics, path))
        self.errors += read_errors(self._root, row, seed, percent)

    def _of_datasets(self) -> None:
        for stage in DATASET_STAGES:
            percents = self._reported.percents if stage == "subset" else (None,)
            for seed, percent in ((seed, percent) for seed in self._reported.seeds for percent in percents):
                path = self._path(stage, "", seed, percent, str(DATASET_PATH))
                if not path.exists():
                    continue
                file = read_json(DatasetFile, path)
                self._add(stage, "", seed, percent, file)
                if percent is None:
                    self.datasets.append(
                        DatasetUse(
                            stage=stage,
                            seed=seed,
                            name=file.name,
                            version=file.version,
                            content_hash=file.content_hash,
                        )
                    )

    def _choice(self) -> None:
        if self.judged is None:
            return
        self._add("select", "", self._reported.seeds[0], None, self.judged)
        for one in self.judged.candidates:
            if one.row in self._reported.methods and one.seed in self._reported.seeds:
                success = {str(judge): share for judge, share in one.success.items()}
                self._line(one.row, one.seed, one.percent, JUDGED, success)

    def origins(self) -> list[Origin]:
        """Return code, machine and packages of all stages, and of this report."""
        made = {**self._made, "report": [Artifact.model_validate(origin())]}
        return merged_origins(
            Origin(commit=file.git_commit, machine=file.machine, packages=file.packages, stages=[stage])
            for stage, of_stage in made.items()
            for file in of_stage
        )


def read_grounding(root: Path, row: str, seed: int, percent: int | None) -> list[Line]:
    """Return times, R² on held-out episodes and predicted failures of a grounding, if it is there."""
    path = root / artifact_key("ground", row, seed, percent) / METRICS
    if not path.is_file():
        return []
    file = read_json(Metrics, path)
    times = {name: getattr(file, name, None) for name in (*_TIMES, *_SPEEDS)}
    last = file.epochs[-1] if file.epochs else {}
    explained = {name: value for name, value in last.items() if name.startswith("r2_")}
    failures = dict(_flat(file.model_dump(include={"failures"})))
    values = without_nan(times | explained | failures)
    size = WHOLE if percent is None else percent
    return [Line(row=row, seed=seed, percent=size, where="ground", values=values)] if values else []


def _flat(values: object, name: str = "") -> Iterator[tuple[str, float]]:
    """Yield the numbers in nested mappings and lists by their dotted names."""
    if isinstance(values, Mapping):
        entries: Iterable[tuple[object, object]] = values.items()
    elif isinstance(values, list | tuple):
        entries = enumerate(values)
    else:
        if values is not None:
            yield name, float(values)  # type: ignore[arg-type]
        return
    for key, value in entries:
        yield from _flat(value, f"{name}.{key}" if name else f"{key}")


def read_errors(root: Path, row: str, seed: int, percent: int | None) -> list[Errors]:
    """Return the open-loop errors of a grounding on held-out episodes, if it is there."""
    path = root / artifact_key("ground", row, seed, percent) / GAP
    if not path.is_file():
        return []
    file = read_json(Gap, path)
    bands = {"still": file.still or {}, "raw": file.raw, "grounded": file.grounded}
    return [
        Errors(
            row=row,
            seed=seed,
            percent=WHOLE if percent is None else percent,
            simulator=simulator,
            quantity=quantity,
            horizons=file.horizons,
            **band.model_dump(),
        )
        for simulator, of in bands.items()
        for quantity, band in of.items()
    ]
