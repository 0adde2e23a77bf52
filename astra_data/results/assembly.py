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
    check_alike,
    way_to_success,
)
from astra_data.results.costs import Files, row_cost, seconds, throughput
from astra_data.results.model import (
    BandMeans,
    Cost,
    Dataset,
    DatasetUse,
    GapMeans,
    Learning,
    MethodResults,
    Origin,
    Results,
    Validity,
)
from astra_data.results.provenance import origin
from astra_data.results.runs import Runs
from astra_data.rows import PLUS, is_plus
from astra_data.statistics import Comparison, correlation, probability_of_improvement, summarise

SHARED_WORLDS = ("raw", "grounded")
"""Simulators that all rows are tested in."""


def assemble(
    recipe: str,
    task: str,
    methods: Sequence[str],
    asked: Sequence[int],
    *,
    root: Path,
    command: str,
    replicates: int,
    groundings: Mapping[str, str] | None = None,
    percent: int | None = None,
    paper_success: Mapping[str, float] | None = None,
) -> Results:
    """Read the artefacts under `root` of every row, for those of the seeds `asked` for that it has finished.

    Of one size of the dataset, `percent`, where there are several.

    Raises:
        MissingStageError: no row has an evaluation, or one has other artefacts for some of its finished
            seeds only.
        BadInputError: an artefact is malformed, or rows were evaluated differently.
    """
    read = Runs(recipe, root, tuple(methods), tuple(asked), groundings or {}, percent)
    evaluations = read.required("evaluate", EVALUATION, Evaluation)
    read.require("evaluate", TRAJECTORIES, tuple(read.finished))
    episodes = check_alike(evaluations, task)
    metrics = read.optional("ground", "metrics.json", Metrics)
    gaps = read.optional("ground", "gap.json", Gap)
    curves = read.optional("train", "curve.json", CurveFile)
    alignments = read.optional("align", "metrics.json", Metrics)
    datasets = {stage: read.datasets(stage) for stage in ("collect", "pair", "subset")}
    gap_means = {owner: _gap_means(list(of_seeds.values())) for owner, of_seeds in gaps.items()}
    rows = {}
    for method, of_seeds in evaluations.items():
        grounding = read.owner("ground", method)
        made: dict[str, Mapping[int, Artefact]] = {
            "ground": metrics.get(grounding, {}),
            "train": curves.get(method, {}),
            "align": alignments.get(read.owner("align", method), {}),
            "evaluate": of_seeds,
        }
        rows[method] = _row(
            method,
            of_seeds,
            grounding,
            [
                way_to_success(read.path("evaluate", method, seed, TRAJECTORIES), file)
                for seed, file in of_seeds.items()
            ],
            gap_means.get(grounding),
            list(curves.get(method, {}).values()),
            row_cost(
                {stage: [found[seed] for seed in of_seeds if seed in found] for stage, found in made.items()}
            ),
            replicates=replicates,
        )
    files: Files = {
        "collect": {"all": list(datasets["collect"].values())},
        "pair": {"all": list(datasets["pair"].values())},
        "ground": _listed(metrics),
        "train": _listed(curves),
        "align": _listed(alignments),
        "evaluate": _listed(evaluations),
    }
    reported = {seed for of_seeds in evaluations.values() for seed in of_seeds}
    return Results(
        recipe=recipe,
        task=task,
        command=command,
        origins=_origins({**files, "report": {"all": [Artefact.model_validate(origin())]}}),
        wall_seconds=seconds(files, "wall_seconds"),
        cpu_seconds=seconds(files, "cpu_seconds"),
        datasets=[
            Dataset(
                stage=stage, seed=seed, name=file.name, version=file.version, content_hash=file.content_hash
            )
            for stage, of_seeds in datasets.items()
            for seed, file in of_seeds.items()
        ],
        evaluated_with=_evaluated_with(evaluations),
        seeds=[seed for seed in asked if seed in reported],
        episodes=episodes,
        leg_scale=next(file.leg_scale for of_seeds in evaluations.values() for file in of_seeds.values()),
        methods=rows,
        paper_success={row: value for row, value in (paper_success or {}).items() if row in rows},
        unfinished=[method_title(method) for method in methods if method not in rows],
        probability_of_improvement=_improvement(rows, replicates),
        predictive_validity=_validity(rows, replicates),
        throughput=throughput(files),
    )


def _listed[T: Artefact](files: Mapping[str, Mapping[int, T]]) -> dict[str, list[T]]:
    return {row: list(of_seeds.values()) for row, of_seeds in files.items()}


def _row(
    method: str,
    of_seeds: Mapping[int, Evaluation],
    grounding: str,
    distances: Sequence[float],
    gap: GapMeans | None,
    curves: Sequence[CurveFile],
    cost: dict[str, Cost],
    *,
    replicates: int,
) -> MethodResults:
    evaluations = list(of_seeds.values())
    means = [file.target.means() for file in evaluations]
    measures = {name: [seed[name] for seed in means] for name in means[0]}
    simulated = _in_world(evaluations, "simulated", "success")
    returns = {world: _in_world(evaluations, world, "return") for world in SHARED_WORLDS}
    summarised = measures | ({} if simulated is None else {"simulated_success": simulated})
    went = [distance for distance in distances if not np.isnan(distance)]
    summarised |= {"distance": went} if went else {}
    measured = [{name: sorted(of) for name, of in file.encoders.items()} for file in evaluations]
    _require_alike(measured, "encoders")
    encoders = {
        encoder: {measure: [file.encoders[encoder][measure] for file in evaluations] for measure in first}
        for encoder, first in evaluations[0].encoders.items()
    }
    return MethodResults(
        title=method_title(method),
        role=ROLES.get(method),
        seeds=list(of_seeds),
        success=measures["success"],
        failed=measures["failed"],
        wall_contact=measures["wall_contact"],
        steps=measures["steps"],
        returns=measures["return"],
        distance=list(distances),
        simulated_success=simulated,
        simulator_returns={world: values for world, values in returns.items() if values is not None},
        encoders=encoders,
        summary={
            name: summarise(np.array(values), replicates=replicates) for name, values in summarised.items()
        },
        grounding=grounding if gap else None,
        gap=gap,
        learning=[
            Learning(
                steps=[point.steps for point in curve.points],
                success=[float("nan") if point.success is None else point.success for point in curve.points],
            )
            for curve in curves
        ],
        cost=cost,
    )


def _in_world(evaluations: Sequence[Evaluation], world: str, measure: str) -> list[float] | None:
    """Return the means of a measure, or None unless every seed was tested in that world."""
    outcomes = [outcome for file in evaluations if (outcome := getattr(file, world)) is not None]
    return [outcome.means()[measure] for outcome in outcomes] if len(outcomes) == len(evaluations) else None


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


def _origins(files: Files) -> list[Origin]:
    origins: dict[str, Origin] = {}
    for stage, rows in files.items():
        for file in (file for row in rows.values() for file in row):
            found = Origin(commit=file.git_commit, machine=file.machine, packages=file.packages, stages=[])
            stages = origins.setdefault(found.model_dump_json(), found).stages
            if stage not in stages:
                stages.append(stage)
    return list(origins.values())


def _evaluated_with(evaluations: Mapping[str, Mapping[int, Evaluation]]) -> list[DatasetUse]:
    uses: dict[tuple[tuple[str | None, str | None], ...], list[str]] = {}
    for method, of_seeds in evaluations.items():
        named = tuple((file.dataset_version, file.dataset_hash) for file in of_seeds.values())
        uses.setdefault(named, []).append(method)
    return [
        DatasetUse(
            versions=[version for version, _ in seeds], hashes=[digest for _, digest in seeds], methods=rows
        )
        for seeds, rows in uses.items()
    ]


def _improvement(rows: Mapping[str, MethodResults], replicates: int) -> dict[str, dict[str, Comparison]]:
    """Compare ASTRA with every other row that is trained as it is, with the [plus] settings or without.

    Rows that were in no simulator are compared with both, for the settings are none of theirs.
    """
    compared = {method: row for method, row in rows.items() if row.role != "ceiling"}
    return {
        ours: {
            other: probability_of_improvement(
                np.array(rows[ours].success), np.array(row.success), replicates=replicates
            )
            for other, row in compared.items()
            if other != ours and (is_plus(other) == is_plus(ours) or row.simulated_success is None)
        }
        for ours in ("astra", f"astra{PLUS}")
        if ours in rows
    }


def _validity(rows: Mapping[str, MethodResults], replicates: int) -> dict[str, Validity]:
    """Correlate the return in each shared simulator with that in the target, over rows and seeds."""
    found = {}
    for world in SHARED_WORLDS:
        tested = [row for row in rows.values() if world in row.simulator_returns]
        simulated = [np.array(row.simulator_returns[world]) for row in tested]
        target = [np.array(row.returns) for row in tested]
        if tested:
            found[world] = Validity(
                policies=sum(map(len, target)),
                pearson=correlation(simulated, target, replicates=replicates),
                spearman=correlation(simulated, target, ranks=True, replicates=replicates),
            )
    return found
