"""Artefacts of all rows and seeds → Results."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pydantic import JsonValue

from astra_data.core.errors import BadInputError
from astra_data.core.provenance import origin
from astra_data.methods import ROLES, method_title
from astra_data.reports.artefacts import (
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
from astra_data.reports.comparing import SHARED_WORLDS
from astra_data.reports.costs import Files, row_cost, seconds, throughput
from astra_data.reports.merging import merge
from astra_data.reports.origins import dataset_uses, merged_origins
from astra_data.reports.runs import Runs
from astra_data.reports.schema import (
    BandMeans,
    Cost,
    Dataset,
    GapMeans,
    Learning,
    MethodResults,
    Origin,
    Results,
)
from astra_data.worlds.score import SUCCESS, Score


def assemble(
    recipe: str,
    task: str,
    methods: Sequence[str],
    asked: Sequence[int],
    *,
    root: Path,
    command: str,
    replicates: int,
    scores: tuple[Score, ...] = (SUCCESS,),
    settings: Mapping[str, JsonValue] | None = None,
    groundings: Mapping[str, str] | None = None,
    percent: int | None = None,
    paper_success: Mapping[str, float] | None = None,
    published: Results | None = None,
) -> Results:
    """Read the artefacts under `root` of every row, for those of the seeds `asked` for that it has finished.

    Of one size of the dataset, `percent`, where there are several; added to what is `published`, if that is
    given.

    Raises:
        MissingStageError: no row has an evaluation, nor is any published; or a row has other artefacts for
            some of its finished seeds only.
        BadInputError: an artefact is malformed, or rows were evaluated or made of data differently.
    """
    read = Runs(recipe, root, tuple(methods), tuple(asked), groundings or {}, percent)
    settings = dict(settings or {})
    sources = []
    if published:
        # It may be that of the recipe that this one is based on.
        own = {"recipe": recipe, "command": command, "settings": settings}
        sources.append(published.model_copy(update=own))
    if read.any_finished or not published:
        sources.append(_read(read, task, command, scores, settings))
    merged = merge(sources, methods=methods, seeds=asked, replicates=replicates)
    printed = {row: value for row, value in (paper_success or {}).items() if row in merged.methods}
    return merged.model_copy(update={"paper_success": printed})


def _read(
    read: Runs, task: str, command: str, scores: tuple[Score, ...], settings: dict[str, JsonValue]
) -> Results:
    """Return what the artefacts say, before rows are summarised and compared."""
    evaluations = read.required("evaluate", EVALUATION, Evaluation)
    read.require("evaluate", TRAJECTORIES, tuple(read.finished))
    episodes = check_alike(evaluations, task)
    metrics = read.optional("ground", "metrics.json", Metrics)
    gaps = read.optional("ground", "gap.json", Gap)
    curves = read.optional("train", "curve.json", CurveFile)
    alignments = read.optional("align", "metrics.json", Metrics)
    datasets = {stage: read.datasets(stage) for stage in ("collect", "pair", "subset")}
    gap_means = {owner: _gap_means(of_seeds) for owner, of_seeds in gaps.items()}
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
            [_learning(curve, scores[0]) for curve in curves.get(method, {}).values()],
            row_cost(
                {stage: [found[seed] for seed in of_seeds if seed in found] for stage, found in made.items()}
            ),
        )
    files: Files = {
        "collect": {"all": list(datasets["collect"].values())},
        "pair": {"all": list(datasets["pair"].values())},
        "ground": _listed(metrics),
        "train": _listed(curves),
        "align": _listed(alignments),
        "evaluate": _listed(evaluations),
    }
    return Results(
        recipe=read.recipe,
        task=task,
        command=command,
        scores=scores,
        settings=settings,
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
        evaluated_with=dataset_uses(
            {
                method: [(file.dataset_version, file.dataset_hash) for file in of_seeds.values()]
                for method, of_seeds in evaluations.items()
            }
        ),
        episodes=episodes,
        leg_scale=next(file.leg_scale for of_seeds in evaluations.values() for file in of_seeds.values()),
        methods=rows,
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
    learning: list[Learning],
    cost: dict[str, Cost],
) -> MethodResults:
    evaluations = list(of_seeds.values())
    means = [file.target.means() for file in evaluations]
    measures = {name: [seed[name] for seed in means] for name in means[0]}
    returns = {world: _in_world(evaluations, world, "return") for world in SHARED_WORLDS}
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
        simulated_success=_in_world(evaluations, "simulated", "success"),
        simulated_steps=_in_world(evaluations, "simulated", "steps"),
        simulator_returns={world: values for world, values in returns.items() if values is not None},
        encoders=encoders,
        grounding=grounding if gap else None,
        gap=gap,
        learning=learning,
        cost=cost,
    )


def _learning(curve: CurveFile, score: Score) -> Learning:
    reached = [point.success if score == SUCCESS else point.episode_steps for point in curve.points]
    return Learning(
        steps=[point.steps for point in curve.points],
        score=[float("nan") if value is None else value for value in reached],
    )


def _in_world(evaluations: Sequence[Evaluation], world: str, measure: str) -> list[float] | None:
    """Return the means of a measure, or None unless every seed was tested in that world."""
    outcomes = [outcome for file in evaluations if (outcome := getattr(file, world)) is not None]
    return [outcome.means()[measure] for outcome in outcomes] if len(outcomes) == len(evaluations) else None


def _require_alike(values: Sequence[object], what: str) -> None:
    if any(value != values[0] for value in values):
        raise BadInputError(f"expected the same {what} for all seeds of a row, got {values}; run them again")


def _gap_means(of_seeds: Mapping[int, Gap]) -> GapMeans:
    gaps = list(of_seeds.values())
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
        seeds=list(of_seeds),
        horizons=shared,
        grounded={name: mean([gap.grounded[name] for gap in gaps]) for name in gaps[0].grounded},
        raw={name: mean([gap.raw[name] for gap in gaps]) for name in gaps[0].raw},
    )


def _origins(files: Files) -> list[Origin]:
    return merged_origins(
        Origin(commit=file.git_commit, machine=file.machine, packages=file.packages, stages=[stage])
        for stage, rows in files.items()
        for row in rows.values()
        for file in row
    )
