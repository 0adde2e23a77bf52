"""Artifacts of all rows and seeds → Results."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from astra_data.core.errors import BadInputError
from astra_data.core.provenance import origin
from astra_data.methods import method_named
from astra_data.reports.artifacts import (
    CURVE,
    GAP,
    METRICS,
    TRAJECTORIES,
    Artifact,
    Band,
    CurveFile,
    Evaluation,
    Gap,
    Metrics,
    check_alike,
    files_of,
    read_json,
    way_to_success,
)
from astra_data.reports.choice import Judged, choice_of, read_judged
from astra_data.reports.comparing import SHARED_WORLDS
from astra_data.reports.costs import DATASET_STAGES, Files, seconds, seed_cost, throughput, with_first
from astra_data.reports.mean_bands import mean_band
from astra_data.reports.merging import merge
from astra_data.reports.origins import code_of_rows, dataset_uses, merged_origins
from astra_data.reports.runs import Reported, Runs
from astra_data.reports.schema import (
    BandMeans,
    Choice,
    DatasetOrigin,
    GapMeans,
    Learning,
    Origin,
    Results,
    shared_horizons,
)
from astra_data.reports.seed_table import Line, row_of
from astra_data.worlds.score import SUCCESS, Score


def assemble(
    reported: Reported,
    *,
    root: Path,
    command: str,
    replicates: int,
    scores: tuple[Score, ...] = (SUCCESS,),
    percent: int | None = None,
    paper_success: Mapping[str, float] | None = None,
    compare: Sequence[str] = ("astra",),
    published: Results | None = None,
) -> Results:
    """Read the artifacts under `root` of every row, for the seeds that it has finished.

    The task is given by its name, as in its evaluations. `percent` selects the dataset size, if there are
    several. Rows of the methods in `compare` are compared with the others. Results in `published` are merged
    in, unless there are newer ones under `root`, which for a choice is one among all policies of the outcome.

    Raises:
        MissingStageError: no row has an evaluation and nothing is published; or a row lacks other artifacts
            for some of its finished seeds.
        BadInputError: an artifact is malformed, or rows differ in task, episodes, robot or data.
    """
    read, sources = Runs(reported, root, percent), []
    if published:
        # The published results may be of the recipe that this one is based on.
        own = {"recipe": reported.name, "command": command, "settings": dict(reported.settings)}
        sources.append(published.model_copy(update=own))
    judged = read_judged(root)
    if read.any_finished or not published:
        sources.append(_read(read, command, scores, judged))
    merged = merge(
        sources, methods=reported.methods, seeds=reported.seeds, replicates=replicates, compare=compare
    )
    printed = {row: value for row, value in (paper_success or {}).items() if row in merged.methods}
    choice = published.choice if published else None
    if judged:
        found = choice_of(
            judged,
            percent,
            measured=_measured(merged),
            rows=reported.methods,
            seeds=reported.seeds,
            replicates=replicates,
        )
        if not published or (found and _is_among_all(found, merged)):
            choice = found
    return merged.model_copy(update={"paper_success": printed, "choice": choice})


def _is_among_all(choice: Choice, results: Results) -> bool:
    """Return whether each policy of `results` that could be a candidate was one."""
    asked = {(one.row, one.seed) for one in choice.candidates}
    able = {row: found for row, found in results.methods.items() if method_named(row).trains_without_target}
    return all((row, seed) in asked for row, found in able.items() for seed in found.seeds)


def _measured(results: Results) -> dict[tuple[str, int], float]:
    """Return the success in the target of every row and seed that was tested there."""
    rows = results.methods if results.tested_in == "target" else {}
    return {
        (method, seed): success
        for method, row in rows.items()
        for seed, success in zip(row.seeds, row.success, strict=True)
    }


def _read(read: Runs, command: str, scores: tuple[Score, ...], judged: Judged | None) -> Results:
    """Return the results under one root, before rows are summarized and compared."""
    evaluations = read.evaluations()
    read.require("evaluate", TRAJECTORIES, tuple(read.finished))
    episodes = check_alike(evaluations, read.reported.task)
    metrics = read.optional("ground", METRICS, Metrics)
    gaps = read.optional("ground", GAP, Gap)
    curves = read.optional("train", CURVE, CurveFile)
    alignments = read.optional("align", METRICS, Metrics)
    datasets = {stage: read.datasets(stage) for stage in DATASET_STAGES}
    gap_means = {owner: mean_gap(of_seeds) for owner, of_seeds in gaps.items()}
    first = _first_trainings(read, evaluations)
    rows, uses = {}, {}
    for method, of_seeds in evaluations.items():
        encoders = [{name: sorted(of) for name, of in file.encoders.items()} for file in of_seeds.values()]
        _require_alike(encoders, "encoders")
        grounding = read.owner("ground", method)
        made: dict[str, Mapping[int, Artifact]] = {
            "ground": metrics.get(grounding, {}),
            "train": curves.get(method, {}),
            "align": alignments.get(read.owner("align", method), {}),
            "evaluate": of_seeds,
        }
        lines = [
            Line(
                method=method,
                seed=seed,
                values=_values(
                    file,
                    way_to_success(read.path("evaluate", method, seed, TRAJECTORIES), file),
                    curves.get(method, {}).get(seed),
                    scores[0],
                ),
                grounding=grounding if grounding in gap_means else None,
                cost=with_first(
                    seed_cost({stage: found[seed] for stage, found in made.items() if seed in found}),
                    first.get(method, {}).get(seed),
                ),
                dataset=(file.dataset_version, file.dataset_hash),
            )
            for seed, file in of_seeds.items()
        ]
        uses[method] = [line.dataset for line in lines]
        rows[method] = row_of(lines, gap_means)
    files: Files = {
        **{stage: {"all": list(of_seeds.values())} for stage, of_seeds in datasets.items() if of_seeds},
        "ground": _listed(metrics),
        "train": _listed(curves),
        "align": _listed(alignments),
        **({"select": {"all": [judged]}} if judged else {}),
        "evaluate": _listed(evaluations),
    }
    # Fine-tuned policies start from those of a row that need not be reported.
    started = {method_named(row).initial or row: of for row, of in first.items()}
    timed: Files = {**files, "train": _listed(started | curves)}
    return Results(
        recipe=read.reported.name,
        task=read.reported.task,
        command=command,
        scores=scores,
        settings=dict(read.reported.settings),
        origins=_origins({**files, "report": {"all": [Artifact.model_validate(origin())]}}),
        own_code=code_of_rows(read.root, rows),
        wall_seconds=seconds(timed, "wall_seconds"),
        cpu_seconds=seconds(timed, "cpu_seconds"),
        datasets=[
            DatasetOrigin(
                stage=stage, seed=seed, name=file.name, version=file.version, content_hash=file.content_hash
            )
            for stage, of_seeds in datasets.items()
            for seed, file in of_seeds.items()
        ],
        evaluated_with=dataset_uses(uses),
        episodes=episodes,
        tested_in="target" if all(file.target for file in files_of(evaluations)) else "simulators",
        leg_scale=files_of(evaluations)[0].leg_scale,
        methods=rows,
        throughput=throughput(files),
    )


def _first_trainings(
    read: Runs, rows: Mapping[str, Mapping[int, Artifact]]
) -> dict[str, dict[int, CurveFile]]:
    """Return, row → seed → file, the trainings from whose policies those of the row start."""
    found: dict[str, dict[int, CurveFile]] = {}
    for row, of_seeds in rows.items():
        if (initial := method_named(row).initial) is not None:
            paths = {seed: read.path("train", initial, seed, CURVE) for seed in of_seeds}
            found[row] = {seed: read_json(CurveFile, path) for seed, path in paths.items() if path.exists()}
    return found


def _listed[T: Artifact](files: Mapping[str, Mapping[int, T]]) -> dict[str, list[T]]:
    return {row: list(of_seeds.values()) for row, of_seeds in files.items()}


def _values(
    evaluation: Evaluation, distance: float, curve: CurveFile | None, score: Score
) -> dict[str, object]:
    """Return the value of each field in `PER_SEED`."""
    means = evaluation.outcomes.means()
    own = evaluation.simulated
    if own is None and evaluation.encoder is None:
        own = evaluation.grounded  # a hand-written row has no simulator of its own
    simulated = {} if own is None else own.means()
    shared = {world: getattr(evaluation, world) for world in SHARED_WORLDS}
    return {
        **{measure: means[measure] for measure in ("success", "failed", "wall_contact", "steps")},
        "returns": means["return"],
        "distance": distance,
        "simulated_success": simulated.get("success"),
        "simulated_steps": simulated.get("steps"),
        "tries": float(len(curve.tries)) if curve and curve.tries else None,
        "beyond_recorded": evaluation.beyond_recorded,
        "simulator_returns": {
            world: outcomes.means()["return"] for world, outcomes in shared.items() if outcomes is not None
        },
        "encoders": evaluation.encoders,
        "learning": None if curve is None else _learning(curve, score),
    }


def _learning(curve: CurveFile, score: Score) -> Learning:
    reached = [point.success if score == SUCCESS else point.episode_steps for point in curve.points]
    return Learning(
        steps=[point.steps for point in curve.points],
        score=[float("nan") if value is None else value for value in reached],
    )


def _require_alike(values: Sequence[object], what: str) -> None:
    if any(value != values[0] for value in values):
        raise BadInputError(f"expected the same {what} for all seeds of a row, got {values}; run them again")


def mean_gap(of_seeds: Mapping[int, Gap]) -> GapMeans:
    """Return the mean over seeds, of the horizons that all of them have.

    Raises:
        BadInputError: they are of different quantities.
    """
    gaps = list(of_seeds.values())
    _require_alike([sorted(gap.grounded) for gap in gaps], "quantities")
    shared = shared_horizons([gap.horizons for gap in gaps])
    places = [[gap.horizons.index(horizon) for horizon in shared] for gap in gaps]

    def mean(bands: Sequence[Band]) -> BandMeans:
        return mean_band(bands, places)

    def mean_still(of_each: Sequence[dict[str, Band] | None]) -> dict[str, BandMeans] | None:
        known = [still for still in of_each if still is not None]
        if len(known) < len(gaps):
            return None
        return {name: mean([still[name] for still in known]) for name in known[0]}

    return GapMeans(
        seeds=list(of_seeds),
        horizons=shared,
        grounded={name: mean([gap.grounded[name] for gap in gaps]) for name in gaps[0].grounded},
        raw={name: mean([gap.raw[name] for gap in gaps]) for name in gaps[0].raw},
        still=mean_still([gap.still for gap in gaps]),
    )


def _origins(files: Files) -> list[Origin]:
    return merged_origins(
        Origin(commit=file.git_commit, machine=file.machine, packages=file.packages, stages=[stage])
        for stage, rows in files.items()
        for row in rows.values()
        for file in row
    )
