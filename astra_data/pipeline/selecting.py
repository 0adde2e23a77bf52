"""Choose among the policies of a run without the target, or end the choice by a few trials in it."""

import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from shutil import copy2
from typing import Any

from astra_data.core.artifact import finished_folder, read_manifest
from astra_data.core.config import only_given, validated
from astra_data.core.durable import alone_in
from astra_data.core.errors import BadInputError
from astra_data.core.progress import Progress, part, silent
from astra_data.core.seeding import derive
from astra_data.pipeline.run import set_aside
from astra_data.pipeline.stages.evaluate import EvaluateConfig
from astra_data.pipeline.stages.select import SelectConfig, benches, digests, judge_in
from astra_data.pipeline.stages.select import select as judge_all
from astra_data.pipeline.trained_policy import settings_of, task_of, trained_policy
from astra_data.pipeline.user_code import add_all
from astra_data.policies.episodes import in_target, started
from astra_data.reports.choice import (
    FOLDER,
    PSEUDO_TRIALS,
    SELECTED,
    TRIALS,
    Candidate,
    Judged,
    TrialRound,
    TrialsFile,
    Tried,
    halve,
    least_trials,
    read_judged,
    read_trials,
    select_page,
    widest_field,
)
from astra_data.reports.runs import Reported
from astra_data.robots.registry import task_named

_log = logging.getLogger(__name__)


def select(
    run: str | Path,
    *,
    rows: Sequence[str] = (),
    judge: str | None = None,
    episodes: int | None = None,
    progress: Progress = silent,
) -> Judged:
    """Judge every trained policy of a run, as the stage `select` does; write `select` in the run's folder.

    A choice that is there is kept if it was made of the same with the same settings, and otherwise set aside.

    Args:
        run: the folder of a run whose recipe has two seeds or more.
        rows: candidates; by default all rows of the recipe that have policies of abstract states.
        judge: the row whose groundings judge; by default as the recipe says, or its reference.
        episodes: of each policy with each judge; by default as the recipe says, or 100.
        progress: called with the share done and a note.

    Raises:
        BadInputError: it is no run, a row is unknown or has no policy, there are no two groundings, or
            another process runs there.
    """
    folder, settings = Path(run), settings_of(run)
    add_all(settings.get("own_methods", {}))
    asked: dict[str, Any] = settings.get("select") or {}
    config = validated(asked | only_given(judge=judge, episodes=episodes), SelectConfig, f"{folder}: select")
    recipe = Reported(
        name=folder.name,
        task=settings["task"],
        methods=tuple(rows) or tuple(settings["methods"]),
        seeds=tuple(settings["seeds"]),
        settings=settings,
        percents=tuple(settings.get("sweep", {}).get("percent", ())),
    )
    with alone_in(folder):
        kept = read_judged(folder) if _is_current(folder, recipe, config) else None
        if kept is None:
            judge_all(recipe, config, root=folder, progress=progress)
            kept = read_judged(folder)
    assert kept is not None
    return kept


def _is_current(folder: Path, recipe: Reported, config: SelectConfig) -> bool:
    """Return whether the choice in `folder` is this one; set aside another one."""
    out = folder / FOLDER
    if out.is_symlink():
        raise BadInputError(
            f"{out} belongs to {out.resolve().parent}, which this run is based on: run select there"
        )
    if not out.is_dir():
        return False
    judge = judge_in(recipe, config)
    read = digests([bench.finished(folder) for bench in benches(recipe, judge)], folder)
    manifest, settings = read_manifest(out), out / "config.json"
    same = manifest is not None and manifest.made_from == read and not manifest.faults(out, verify=False)
    if same and settings.read_text() == config.model_dump_json(indent=1):
        return True
    aside = set_aside(folder, FOLDER)
    if (aside / TRIALS).is_file():
        _log.warning("choosing again; the old choice, with its trials in the target, is in %s", aside)
    return False


def choose_by_trials(
    run: str | Path,
    trials: int,
    *,
    field: int | None = None,
    percent: int | None = None,
    rows: Sequence[str] = (),
    judge: str | None = None,
    episodes: int | None = None,
    progress: Progress = silent,
) -> TrialsFile:
    """Spend so many episodes in the target on the candidates of a run; write `select/trials.json`.

    Candidates of a round meet the same starts and goals, others than those of `evaluate`. An interrupted call
    goes on with the next candidate.

    Args:
        run: the folder of a run, whose policies are trained and aligned.
        trials: episodes in the target, at most.
        field: how many of the best predicted are tried; by default as many as the trials are enough for.
        percent: the size of the dataset, where the recipe sweeps over sizes.
        rows: as for `select`.
        judge: as for `select`.
        episodes: as for `select`.
        progress: called with the share done and a note.

    Raises:
        BadInputError: as `select`; or the task has no target, the trials are too few, or others were made.
    """
    folder, task = Path(run), task_of(run)
    if not task_named(task).has_target:
        raise BadInputError(f"{folder}: expected a task with a target, got {task}: leave out --trials")
    _check_enough(trials, 2 if field is None else field)
    judged = select(run, rows=rows, judge=judge, episodes=episodes, progress=part(progress, 0.0, 0.5))
    candidates = _candidates(judged, percent)
    if not 2 <= (field or len(candidates)) <= len(candidates):
        raise BadInputError(
            f"expected two candidates or more to try, of the {len(candidates)} that were judged, got "
            f"{field or len(candidates)}: give another --field, or more rows"
        )
    begun = _begun(folder, trials, field or widest_field(len(candidates), trials), percent)
    with alone_in(folder):
        return _halve(folder, judged, candidates, begun, part(progress, 0.5, 1.0))


def _check_enough(trials: int, field: int) -> None:
    least = least_trials(field)
    if field < 2 or trials < least:
        raise BadInputError(
            f"expected --trials of {max(least, least_trials(2))} or more, for a first round of {field} "
            f"candidates and those after it, got {trials}: give more, or another --field of 2 or more"
        )


def _candidates(judged: Judged, percent: int | None) -> list[Candidate]:
    if percent not in judged.percents:
        sizes = ", ".join(f"{size}" for size in judged.percents if size) or "none"
        asked = percent or "none"
        raise BadInputError(f"expected --percent to be a size of the run ({sizes}), got {asked}")
    return judged.ranked(percent)


def _begun(folder: Path, trials: int, field: int, percent: int | None) -> TrialsFile:
    """Return what is there of such trials, or none of them."""
    path = folder / FOLDER / TRIALS
    asked = TrialsFile(trials=trials, field=field, percent=percent, pseudo_trials=PSEUDO_TRIALS)
    there = read_trials(path) or asked
    for name in ("trials", "field", "percent", "pseudo_trials"):
        was, now = getattr(there, name), getattr(asked, name)
        if was != now:
            raise BadInputError(
                f"{path}: expected trials with {name} = {now}, found {there.spent} made with {was}: "
                f"use the same settings, or move {path.parent} away"
            )
    return there


def _halve(
    folder: Path, judged: Judged, candidates: list[Candidate], begun: TrialsFile, progress: Progress
) -> TrialsFile:
    """Go on with what was begun; of what is finished, nothing is tried again."""
    rounds = list(begun.rounds)

    def attempt(number: int, those: tuple[int, ...], each: int) -> list[int]:
        named = [(candidates[one].row, candidates[one].seed) for one in those]
        if number == len(rounds):
            rounds.append(TrialRound(trials=each, candidates=named))
        for row, seed in named[len(rounds[number].tried) :]:
            success = _try(folder, row, seed, begun.percent, each, number)
            tried = [*rounds[number].tried, Tried(row=row, seed=seed, success=success)]
            rounds[number] = rounds[number].model_copy(update={"tried": tried})
            now = begun.model_copy(update={"rounds": rounds})
            _write(folder, judged, now)
            progress(now.spent / begun.trials, f"{row}, seed {seed}: {sum(success)} of {each}")
        return [sum(one.success) for one in rounds[number].tried]

    priors = [one.lower for one in candidates]
    found = halve(priors, begun.trials, attempt, field=begun.field)
    first = candidates[found.chosen]
    done = begun.model_copy(update={"rounds": rounds, "chosen": (first.row, first.seed), "mean": found.mean})
    _write(folder, judged, done)
    return done


def _try(folder: Path, row: str, seed: int, percent: int | None, trials: int, number: int) -> list[int]:
    """Return 1 or 0 for each episode of a policy in the target, deployed as `evaluate` does it."""
    trained = trained_policy(folder, row, seed=seed, percent=percent)
    config, policy = EvaluateConfig.model_validate(trained.settings.get("evaluate") or {}), trained.running()
    drawn = derive(number, "trials of a choice")
    begin = partial(started, policy, policy.act)
    found = in_target(policy.task, begin, trials, drawn, leg_scale=config.leg_scale)
    return [int(success) for success in found.outcome.success]


def _write(folder: Path, judged: Judged, trials: TrialsFile) -> None:
    """Write the choice again, with its trials."""
    out = folder / FOLDER
    manifest = read_manifest(out)
    assert manifest is not None
    with finished_folder(out, replace=True, made_from=manifest.made_from) as partly:
        for name in ("config.json", SELECTED):
            copy2(out / name, partly / name)
        (partly / TRIALS).write_text(trials.model_dump_json(indent=1))
        (partly / "select.md").write_text(select_page(folder.name, judged, trials))
