"""Artefacts of all rows and seeds → Results."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from astra_data.errors import BadInputError
from astra_data.figures import ROLES, method_title
from astra_data.results.artefacts import (
    EVALUATION,
    TRAJECTORIES,
    Artefact,
    Band,
    CurveFile,
    Evaluation,
    Gap,
    Metrics,
)
from astra_data.results.model import (
    BandMeans,
    Dataset,
    DatasetUse,
    GapMeans,
    Learning,
    MethodResults,
    Origin,
    Results,
)
from astra_data.results.provenance import origin
from astra_data.results.runs import Runs
from astra_data.rows import PLUS, is_plus
from astra_data.statistics import Comparison, probability_of_improvement, summarise

THROUGHPUT = {
    "collect": ("target_steps_per_second",),
    "pair": ("pairs_per_second",),
    "ground": ("windows_per_second",),
    "train": ("simulator_steps_per_second", "steps_per_second"),
    "align": ("windows_per_second",),
    "evaluate": ("target_steps_per_second",),
}
"""The figures in which each stage gives its speed."""


def assemble(
    recipe: str,
    task: str,
    methods: Sequence[str],
    seeds: Sequence[int],
    *,
    root: Path,
    command: str,
    replicates: int,
    groundings: Mapping[str, str] | None = None,
    percent: int | None = None,
) -> Results:
    """Read every artefact under `root` and summarise it; of one size of the dataset where there are several.

    Raises:
        MissingStageError: a row has no evaluation, or other artefacts for some of its seeds only.
        BadInputError: an artefact is malformed, or rows were evaluated differently.
    """
    read = Runs(recipe, root, tuple(methods), tuple(seeds), groundings or {}, percent)
    evaluations = read.required("evaluate", EVALUATION, Evaluation)
    read.require("evaluate", TRAJECTORIES, methods)
    episodes = _check_alike(evaluations, task)
    metrics = read.optional("ground", "metrics.json", Metrics)
    gaps = read.optional("ground", "gap.json", Gap)
    curves = read.optional("train", "curve.json", CurveFile)
    alignments = read.optional("align", "metrics.json", Metrics)
    datasets = {stage: read.datasets(stage) for stage in ("collect", "pair", "subset")}
    rows = {
        method: _row(
            method,
            evaluations[method],
            read.owner("ground", method),
            gaps,
            curves.get(method, []),
            replicates=replicates,
        )
        for method in methods
    }
    files: dict[str, Mapping[str, Sequence[Artefact]]] = {
        "collect": {"all": list(datasets["collect"].values())},
        "pair": {"all": list(datasets["pair"].values())},
        "ground": metrics,
        "train": curves,
        "align": alignments,
        "evaluate": evaluations,
    }
    return Results(
        recipe=recipe,
        task=task,
        command=command,
        origins=_origins(files | {"report": {"all": [Artefact.model_validate(origin())]}}),
        wall_seconds=_wall_seconds(files),
        datasets=[
            Dataset(
                stage=stage, seed=seed, name=file.name, version=file.version, content_hash=file.content_hash
            )
            for stage, of_seeds in datasets.items()
            for seed, file in of_seeds.items()
        ],
        evaluated_with=_evaluated_with(evaluations),
        seeds=list(seeds),
        episodes=episodes,
        methods=rows,
        probability_of_improvement=_improvement(rows, replicates),
        throughput={stage: _throughput(stage, rows_files) for stage, rows_files in files.items()},
    )


def _check_alike(evaluations: dict[str, list[Evaluation]], task: str) -> int:
    """Return the episodes per row and seed after checking that rows can be compared."""
    files = [file for row in evaluations.values() for file in row]
    episodes = files[0].episodes
    wrong = [f"{file.method} seed {file.seed} on {file.task}" for file in files if file.task != task]
    wrong += [
        f"{file.method} seed {file.seed} with {file.episodes} episodes"
        for file in files
        if file.episodes != episodes
    ]
    if wrong:
        raise BadInputError(
            f"expected every row evaluated on {task} with {episodes} episodes, got {', '.join(wrong)}; "
            "evaluate those rows again"
        )
    return episodes


def _row(
    method: str,
    evaluations: Sequence[Evaluation],
    grounding: str,
    gaps: dict[str, list[Gap]],
    curves: Sequence[CurveFile],
    *,
    replicates: int,
) -> MethodResults:
    means = [file.target.means() for file in evaluations]
    measures = {name: [seed[name] for seed in means] for name in means[0]}
    simulated = [file.simulated.means()["success"] for file in evaluations if file.simulated is not None]
    in_simulator = len(simulated) == len(evaluations)
    summarised = measures | ({"simulated_success": simulated} if in_simulator else {})
    measured = [{name: sorted(of) for name, of in file.encoders.items()} for file in evaluations]
    _require_alike(measured, "encoders")
    encoders = {
        encoder: {measure: [file.encoders[encoder][measure] for file in evaluations] for measure in first}
        for encoder, first in evaluations[0].encoders.items()
    }
    return MethodResults(
        title=method_title(method),
        role=ROLES.get(method),
        success=measures["success"],
        topple=measures["topple"],
        wall_contact=measures["wall_contact"],
        steps=measures["steps"],
        returns=measures["return"],
        simulated_success=simulated if in_simulator else None,
        encoders=encoders,
        summary={
            name: summarise(np.array(values), replicates=replicates) for name, values in summarised.items()
        },
        grounding=grounding if grounding in gaps else None,
        gap=_gap_means(gaps[grounding]) if grounding in gaps else None,
        learning=[
            Learning(
                steps=[point.steps for point in curve.points],
                success=[float("nan") if point.success is None else point.success for point in curve.points],
            )
            for curve in curves
        ],
    )


def _require_alike(values: Sequence[object], what: str) -> None:
    if any(value != values[0] for value in values):
        raise BadInputError(f"expected the same {what} for all seeds of a row, got {values}; run them again")


def _gap_means(gaps: Sequence[Gap]) -> GapMeans:
    _require_alike([sorted(gap.grounded) for gap in gaps], "quantities")
    # A seed whose episodes are short has no long horizons.
    shared = [horizon for horizon in gaps[0].horizons if all(horizon in gap.horizons for gap in gaps)]
    places = [[gap.horizons.index(horizon) for horizon in shared] for gap in gaps]

    def mean(bands: Sequence[Band]) -> BandMeans:
        ends = np.mean(
            [
                np.array([band.mean, band.low, band.high])[:, kept]
                for band, kept in zip(bands, places, strict=True)
            ],
            axis=0,
        )
        return BandMeans(mean=ends[0].tolist(), low=ends[1].tolist(), high=ends[2].tolist())

    return GapMeans(
        horizons=shared,
        grounded={name: mean([gap.grounded[name] for gap in gaps]) for name in gaps[0].grounded},
        raw={name: mean([gap.raw[name] for gap in gaps]) for name in gaps[0].raw},
    )


def _origins(files: Mapping[str, Mapping[str, Sequence[Artefact]]]) -> list[Origin]:
    origins: dict[str, Origin] = {}
    for stage, rows in files.items():
        for file in (file for row in rows.values() for file in row):
            found = Origin(commit=file.git_commit, machine=file.machine, packages=file.packages, stages=[])
            stages = origins.setdefault(found.model_dump_json(), found).stages
            if stage not in stages:
                stages.append(stage)
    return list(origins.values())


def _wall_seconds(files: Mapping[str, Mapping[str, Sequence[Artefact]]]) -> dict[str, float]:
    recorded = {
        stage: [file.wall_seconds for row in rows.values() for file in row if file.wall_seconds is not None]
        for stage, rows in files.items()
    }
    seconds = {stage: sum(times) for stage, times in recorded.items() if times}
    return seconds | {"total": sum(seconds.values())}


def _throughput(stage: str, files: Mapping[str, Sequence[Artefact]]) -> dict[str, dict[str, list[float]]]:
    figures = {}
    for figure in THROUGHPUT[stage]:
        speeds = {method: [getattr(file, figure) for file in row] for method, row in files.items()}
        figures[figure] = {method: row for method, row in speeds.items() if row and None not in row}
    return figures


def _evaluated_with(evaluations: dict[str, list[Evaluation]]) -> list[DatasetUse]:
    uses: dict[tuple[tuple[str | None, str | None], ...], list[str]] = {}
    for method, files in evaluations.items():
        uses.setdefault(tuple((file.dataset_version, file.dataset_hash) for file in files), []).append(method)
    return [
        DatasetUse(
            versions=[version for version, _ in seeds], hashes=[digest for _, digest in seeds], methods=rows
        )
        for seeds, rows in uses.items()
    ]


def _improvement(rows: dict[str, MethodResults], replicates: int) -> dict[str, dict[str, Comparison]]:
    """Compare ASTRA with every other row that is trained as it is, with the [plus] settings or without."""
    success = {method: np.array(row.success) for method, row in rows.items() if row.role != "ceiling"}
    return {
        ours: {
            other: probability_of_improvement(success[ours], scores, replicates=replicates)
            for other, scores in success.items()
            if other != ours and is_plus(other) == is_plus(ours)
        }
        for ours in ("astra", f"astra{PLUS}")
        if ours in success
    }
