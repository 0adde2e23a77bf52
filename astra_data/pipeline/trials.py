"""End a choice by trials in the target: successive halving, from the prediction of `select` on."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from shutil import copy2

from astra_data.core.artifact import finished_folder
from astra_data.core.errors import BadInputError
from astra_data.core.lock import alone_in
from astra_data.core.manifest import read_manifest
from astra_data.core.progress import Progress, part, silent
from astra_data.core.seeding import derive
from astra_data.pipeline.selecting import select
from astra_data.pipeline.stages.evaluate import EvaluateConfig
from astra_data.pipeline.trained_policy import task_of, trained_policy
from astra_data.policies.simulator_episodes import started
from astra_data.policies.target_episodes import in_target
from astra_data.reports.choice import FOLDER, SELECTED, Candidate, Judged, select_page
from astra_data.reports.trials import (
    PSEUDO_TRIALS,
    TRIALS,
    TrialRound,
    TrialsFile,
    Tried,
    halve,
    least_trials,
    read_trials,
    widest_field,
)
from astra_data.robots.registry import task_named


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
