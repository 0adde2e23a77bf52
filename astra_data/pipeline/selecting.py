"""Choose among the policies of a run without the target, or end the choice by a few trials in it."""

import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.artifact import read_manifest
from astra_data.core.config import only_given, validated
from astra_data.core.durable import alone_in, write_file
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.core.progress import Progress, part, silent
from astra_data.core.seeding import derive
from astra_data.pipeline.by_hand import Ask, Sheet
from astra_data.pipeline.run import set_aside
from astra_data.pipeline.stages.evaluate import EvaluateConfig
from astra_data.pipeline.stages.select import SelectConfig, benches, digests, judge_in, predicted_from
from astra_data.pipeline.stages.select import select as judge_all
from astra_data.pipeline.trained_policy import settings_of, trained_policy
from astra_data.pipeline.user_code import add_all
from astra_data.policies.episodes import in_target, started
from astra_data.reports import choice
from astra_data.reports.artifacts import read_json
from astra_data.reports.runs import Reported
from astra_data.robots.registry import task_named
from astra_data.worlds.task import Task

_log = logging.getLogger(__name__)


def select(
    run: str | Path,
    *,
    rows: Sequence[str] = (),
    judge: str | None = None,
    episodes: int | None = None,
    progress: Progress = silent,
) -> choice.Judged:
    """Judge every trained policy of a run, as the stage `select` does; a choice made of the same is kept."""
    folder, (recipe, config) = Path(run), asked_of(run, rows, judge, episodes)
    with alone_in(folder):
        if not _is_current(folder, recipe, config):
            judge_all(recipe, config, root=folder, progress=progress)
        return read_json(choice.Judged, folder / choice.FOLDER / choice.SELECTED)


def asked_of(
    run: str | Path, rows: Sequence[str] = (), judge: str | None = None, episodes: int | None = None
) -> tuple[Reported, SelectConfig]:
    """Return what is judged of a run, and how; without `rows` all, and as its recipe says."""
    folder, settings = Path(run), settings_of(run)
    add_all(settings.get("user_methods", {}))
    asked = (settings.get("select") or {}) | only_given(judge=judge, episodes=episodes)
    config = validated(asked, SelectConfig, f"{folder}: select")
    recipe = Reported(
        name=folder.name,
        task=settings["task"],
        methods=tuple(rows) or tuple(settings["methods"]),
        seeds=tuple(settings["seeds"]),
        settings=settings,
        percents=tuple(settings.get("sweep", {}).get("percent", ())),
    )
    return recipe, config


def _is_current(folder: Path, recipe: Reported, config: SelectConfig) -> bool:
    """Return whether the choice in `folder` is this one; set aside another one."""
    out = folder / choice.FOLDER
    if out.is_symlink():
        raise BadInputError(f"{out} belongs to {out.resolve().parent}, which this run is based on: run select there")
    if not out.is_dir():
        return False
    read = digests([bench.finished(folder) for bench in benches(recipe, judge_in(recipe, config))], folder)
    manifest = read_manifest(out)
    same = manifest is not None and manifest.made_from == read and not manifest.faults(out, verify=False)
    same = same and (out / choice.PAGE).is_file()
    if same and (out / "config.json").read_text() == config.model_dump_json(indent=1):
        return True
    aside = set_aside(folder, choice.FOLDER)
    if (aside / choice.TRIALS).is_file():
        _log.warning("choosing again; the old choice, with its trials in the target, is in %s", aside)
    return False


def check_trials(run: str | Path, trials: int, *, by_hand: bool, field: int | None, percent: int | None) -> Task:
    """Refuse so many trials before anything is judged anew or set aside; return the task of the run."""
    folder, settings = Path(run), settings_of(run)
    task, sizes = task_named(str(settings["task"])), settings.get("sweep", {}).get("percent") or [None]
    if not by_hand and not task.has_target:
        raise BadInputError(
            f"{folder}: expected a task with a target, got {settings['task']}: leave out --trials, or make "
            "them at the robot, with --by-hand"
        )
    if field is not None and field < 2:
        raise BadInputError(f"--field: expected 2 candidates or more, got {field}")
    if trials < (least := choice.least_trials(field or 2)):
        raise BadInputError(
            f"expected --trials of {least} or more, for a first round of {field or 2} candidates and those "
            f"after it, got {trials}: give more, or another --field"
        )
    if percent not in sizes:
        known = ", ".join(f"{size}" for size in sizes if size) or "none"
        raise BadInputError(f"expected --percent to be a size of the run ({known}), got {percent or 'none'}")
    return task


def choose_by_trials(
    run: str | Path,
    trials: int,
    *,
    by_hand: Ask | None = None,
    field: int | None = None,
    percent: int | None = None,
    rows: Sequence[str] = (),
    judge: str | None = None,
    episodes: int | None = None,
    progress: Progress = silent,
) -> choice.TrialsFile:
    """Spend so many episodes in the target on the candidates of a run, `field` at most; write `select/trials.json`.

    With `by_hand` a person makes them at the robot; what is returned has no `chosen` while any are still to be made.
    """
    folder, task = Path(run), check_trials(run, trials, by_hand=by_hand is not None, field=field, percent=percent)
    judged = select(run, rows=rows, judge=judge, episodes=episodes, progress=part(progress, 0.0, 0.5))
    candidates = judged.ranked(percent)
    if not 2 <= (asked := field or len(candidates)) <= len(candidates):
        of = f"of the {len(candidates)} that were judged, got {asked}"
        raise BadInputError(f"expected two candidates or more to try, {of}: give another --field, or more rows")
    field = field or choice.widest_field(len(candidates), trials)
    begun = choice.TrialsFile(
        trials=trials, field=field, percent=percent, by_hand=by_hand is not None, pseudo_trials=choice.PSEUDO_TRIALS
    )
    path = folder / choice.FOLDER / choice.TRIALS
    if there := choice.read_trials(folder):
        for name, now in begun.model_dump(include={"trials", "field", "percent", "by_hand", "pseudo_trials"}).items():
            if (was := getattr(there, name)) != now:
                raise BadInputError(
                    f"{path}: expected trials with {name} = {now}, found {there.spent} made with {was}: "
                    f"use the same settings, or move {path.parent} away"
                )
    begun, shown = there or begun, part(progress, 0.5, 1.0)
    begun = begun.model_copy(update={"chosen": None, "mean": None, "rate": None})  # results may have been corrected
    rounds = list(begun.rounds)  # of which nothing is tried again
    sheet = Sheet(path.parent / choice.SHEET, task)

    def planned(number: int) -> list[Tensor]:
        rng, one = np.random.default_rng(derive(number, "trials by hand")), rounds[number]
        starts = task.objective.draw_starts(rng, one.trials), task.objective.draw_goals(rng, one.trials)
        sheet.plan(number, one.candidates, *starts)
        return [torch.from_numpy(values) for values in starts]

    def at_robot(number: int, those: tuple[int, ...], ask: Ask) -> None:
        if not rounds[number].predicted:
            (recipe, config), starts, predicted = asked_of(run, rows, judge, episodes), planned(number), []
            for one in those:
                shown(0.0, f"predicts {candidates[one].name} from the starts of round {number + 1}")
                predicted.append(predicted_from(recipe, config, candidates[one], *starts, root=folder))
            rounds[number] = rounds[number].model_copy(update={"predicted": predicted})
            _write(folder, judged, begun.model_copy(update={"rounds": rounds}))

        def state() -> str:
            tried = []
            for (row, seed), predicted in zip(rounds[number].candidates, rounds[number].predicted, strict=True):
                success, of = sheet.counted(number, (row, seed), predicted)
                tried.append(choice.Tried(row=row, seed=seed, success=success, predicted=of))
            rounds[number] = rounds[number].model_copy(update={"tried": tried})
            return choice.advice(judged, begun.model_copy(update={"rounds": rounds}))

        is_filled = sheet.fill(number, ask, state)
        state()
        if not is_filled:
            raise _LeftForLaterError

    def attempt(number: int, those: tuple[int, ...], each: int) -> list[int]:
        named = [(candidates[one].row, candidates[one].seed) for one in those]
        if number == len(rounds):
            rounds.append(choice.TrialRound(trials=each, candidates=named))
        if {*rounds[number].candidates} != {*named}:
            raise BadInputError(
                f"{sheet.path}: expected the results that round {number + 1} was planned for, found others in an "
                f"earlier round: restore them, or move {path.parent} away to begin anew"
            )
        if by_hand is not None:
            at_robot(number, those, by_hand)
        for row, seed in named[len(rounds[number].tried) :]:
            trained = trained_policy(folder, row, seed=seed, percent=begun.percent)
            scale = EvaluateConfig.model_validate(trained.settings.get("evaluate") or {}).leg_scale
            policy = trained.running()
            begin, drawn = partial(started, policy, policy.act), derive(number, "trials of a choice")
            outcome = in_target(policy.task, begin, each, drawn, leg_scale=scale).outcome
            success = [int(one) for one in outcome.success]
            tried = [*rounds[number].tried, choice.Tried(row=row, seed=seed, success=success)]
            rounds[number] = rounds[number].model_copy(update={"tried": tried})
            now = begun.model_copy(update={"rounds": rounds})
            _write(folder, judged, now)
            shown(now.spent / begun.trials, f"{row}, seed {seed}: {sum(success)} of {each}")
        counts = {(one.row, one.seed): sum(one.success) for one in rounds[number].tried}
        return [counts[key] for key in named]

    with alone_in(folder):
        for number in range(len(rounds) if by_hand else 0):
            planned(number)
        if sheet.results and (begun.spent or sheet.path.is_file()):
            sheet.read()
        try:
            chosen, mean = choice.halve([one.lower for one in candidates], begun.trials, attempt, field=begun.field)
            first = candidates[chosen]
            rate = choice.standings(judged, percent, rounds)[first.row, first.seed].rate
            end = {"chosen": (first.row, first.seed), "mean": mean, "rate": (rate.value, rate.low, rate.high)}
        except _LeftForLaterError:
            end = dict[str, Any]()
        done = begun.model_copy(update={"rounds": rounds} | end)
        _write(folder, judged, done)
    shown(1.0, choice.advice(judged, done))
    return done


class _LeftForLaterError(Exception):
    """Trials by hand are still to be made."""


def _write(folder: Path, judged: choice.Judged, trials: choice.TrialsFile) -> None:
    """Write the trials so far, and the page again."""
    out = folder / choice.FOLDER
    write_file(out / choice.TRIALS, trials.model_dump_json(indent=1))
    write_file(out / choice.PAGE, choice.select_page(folder.name, judged, trials))
