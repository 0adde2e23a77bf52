"""Choose among the policies of a run without the target, or end the choice by a few trials in it or at the robot."""

import csv
import io
import logging
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.artifact import read_manifest
from astra_data.core.config import only_given, validated
from astra_data.core.durable import alone_in, write_file
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.core.progress import Progress, part, silent
from astra_data.core.seeding import derive
from astra_data.pipeline.recipe import add_all
from astra_data.pipeline.run import set_aside
from astra_data.pipeline.stages.evaluate import EvaluateConfig
from astra_data.pipeline.stages.select import SelectConfig, benches, digests, judge_in, predicted_from
from astra_data.pipeline.stages.select import select as judge_all
from astra_data.pipeline.trained_policy import settings_of, trained_policy
from astra_data.policies.episodes import in_target, started
from astra_data.reports import choice
from astra_data.reports.artifacts import found_json, read_json
from astra_data.reports.runs import Reported
from astra_data.robots.registry import task_named
from astra_data.worlds.task import Task, names_with_units

_log = logging.getLogger(__name__)
KEYS = {"s": "success", "f": "failure", "v": "void"}
QUIT = "q"
Ask = Callable[[str], str]  # given what to do in the next trial, returns one of `KEYS`, or `QUIT` to leave it for later
Trial = tuple[str, ...]  # a line of the sheet before its result: round and number in it, policy, start and goal


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
        methods=tuple(rows or settings["methods"]),
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
        advice = "leave out --trials, or make them at the robot, with --by-hand"
        raise BadInputError(f"{folder}: expected a task with a target, got {settings['task']}: {advice}")
    if field is not None and field < 2:
        raise BadInputError(f"--field: expected 2 candidates or more, got {field}")
    if trials < (least := choice.least_trials(field or 2)):
        first = f"for a first round of {field or 2} candidates and those after it, got {trials}"
        raise BadInputError(f"expected --trials of {least} or more, {first}: give more, or another --field")
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
) -> choice.Trials:
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
    settings: dict[str, Any] = {"trials": trials, "field": field, "percent": percent, "by_hand": by_hand is not None}
    settings["pseudo_trials"] = choice.PSEUDO_TRIALS
    path = folder / choice.FOLDER / choice.TRIALS
    if there := found_json(choice.Trials, path):
        for name, now in settings.items():
            if (was := getattr(there, name)) != now:
                found = f"{there.spent} made with {was}: use the same settings, or move {path.parent} away"
                raise BadInputError(f"{path}: expected trials with {name} = {now}, found {found}")
    rounds = list(there.rounds) if there else []  # of which nothing is tried again
    begun, shown = choice.Trials(**settings, rounds=rounds), part(progress, 0.5, 1.0)  # results may have been corrected
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
                success, of = sheet.counted(number, row, seed, predicted)
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
            expected = f"expected the results that round {number + 1} was planned for, found others in an earlier round"
            raise BadInputError(f"{sheet.path}: {expected}: restore them, or move {path.parent} away to begin anew")
        if by_hand is not None:
            at_robot(number, those, by_hand)
        for row, seed in named[len(rounds[number].tried) :]:
            trained = trained_policy(folder, row, seed=seed, percent=begun.percent)
            scale = EvaluateConfig.model_validate(trained.settings.get("evaluate") or {}).leg_scale
            policy = trained.running()
            begin, drawn = partial(started, policy, policy.act), derive(number, "trials of a choice")
            outcome = in_target(policy.task, begin, each, drawn, leg_scale=scale)
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


def _write(folder: Path, judged: choice.Judged, trials: choice.Trials) -> None:
    """Write the trials so far, and the page again."""
    out = folder / choice.FOLDER
    write_file(out / choice.TRIALS, trials.model_dump_json(indent=1))
    write_file(out / choice.PAGE, choice.select_page(folder.name, judged, trials))


class Sheet:
    """`trials.csv`: each trial of the rounds so far with its results: void ones, then the one that counts."""

    def __init__(self, path: Path, task: Task) -> None:
        start, goal = names_with_units(task.abstract_state), names_with_units(task.goal) if task.goal else []
        ends = [name if name.startswith("goal") else f"goal_{name}" for name in goal]
        self.path, self.results = path, dict[Trial, list[str]]()
        self._limit_s = task.objective.horizon * task.timestep_s
        self._header = ["round", "trial", "policy", *(f"start_{name}" for name in start), *ends, "result"]

    def plan(self, number: int, candidates: Iterable[tuple[str, int]], start: Floats, goal: Floats) -> None:
        """Add round `number`: each candidate once from each start (N, X) to its goal (N, G)."""
        named, places = [f"{row}/seed_{seed}" for row, seed in candidates], np.concatenate([start, goal], axis=1)
        for each, place in enumerate(places):
            values = [f"{value + 0.0:.4g}" for value in place]
            for one, name in enumerate(named):
                self.results[f"{number + 1}", f"{each * len(named) + one + 1}", name, *values] = []

    def counted(self, number: int, row: str, seed: int, predicted: Sequence[float]) -> tuple[list[int], list[float]]:
        """Return a candidate's results of a round that count, 1 or 0, with what is `predicted` of the same starts."""
        trials = [one for one in self.results if one[0] == f"{number + 1}" and one[2] == f"{row}/seed_{seed}"]
        found = [(self.success(one), of) for one, of in zip(trials, predicted, strict=True)]
        return [one for one, _ in found if one is not None], [of for one, of in found if one is not None]

    def success(self, trial: Trial) -> int | None:
        """Return 1 or 0; None for a trial that is still to be made."""
        counts = [result for result in self.results[trial] if result != "void"]
        return int(counts[0] == "success") if counts else None

    def read(self) -> None:
        """Take the results from the file; nothing is taken from a malformed one."""
        try:
            lines = [*csv.reader(io.StringIO(self.path.read_text(encoding="utf-8-sig"), newline=""), strict=True)]
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            advice = "save it as CSV with commas, in UTF-8; or move the folder away to begin anew"
            raise BadInputError(f"{self.path}: expected the sheet of the trials, found {error}: {advice}") from None
        found, planned = {trial: list[str]() for trial in self.results}, {trial[:3]: trial for trial in self.results}
        if not lines or lines[0] != self._header:
            self._refuse(1, ",".join(self._header), ",".join(lines[0]) if lines else "nothing")
        for number, cells in enumerate(lines[1:], start=2):
            if not any(cells):
                continue
            if len(cells) != len(self._header):
                self._refuse(number, f"{len(self._header)} cells", f"{len(cells)}")
            trial, result = planned.get((*cells[:3],)), cells[-1].strip().lower()
            if trial is None:
                self._refuse(number, "round, trial and policy as planned", ",".join(cells[:3]))
            for name, now, planned_value in zip(self._header[3:], cells[3:-1], trial[3:], strict=False):
                if not _same(now, planned_value):
                    self._refuse(number, f"{name} {planned_value}", now)
            result = KEYS.get(result, result)
            if result and result not in KEYS.values():
                self._refuse(number, "success, failure, void or nothing as result", cells[-1])
            if result and result != "void" and any(one != "void" for one in found[trial]):
                self._refuse(number, f"one result of trial {trial[1]} of round {trial[0]}", f"a second, {result}")
            found[trial] += [result] if result else []
        self.results = found

    def _refuse(self, number: int, expected: str, found: str) -> NoReturn:
        advice = "change that, or remove the line for a new one; a trial that began elsewhere is void"
        raise BadInputError(f"{self.path}, line {number}: expected {expected}, found {found or 'nothing'}: {advice}")

    def write(self) -> None:
        """Write all trials, and an open line for each that has no result that counts."""
        text = io.StringIO()
        lines = csv.writer(text, lineterminator="\n")
        lines.writerow(self._header)
        for trial, results in self.results.items():
            still = [""] if self.success(trial) is None else []
            lines.writerows([*trial, result] for result in sorted(results, key="void".__ne__) + still)
        write_file(self.path, text.getvalue())

    def fill(self, number: int, ask: Ask, state: Callable[[], str]) -> bool:
        """Ask for the results that a round still lacks, each after the `state` so far; return whether it has all."""
        self.write()
        trials = [one for one in self.results if one[0] == f"{number + 1}"]
        for trial in trials:
            while self.success(trial) is None:
                key = ask(f"{state()}\n{self._words(trial, len(trials))}")
                if key == QUIT:
                    return False
                if key in KEYS:
                    self.read()  # what was filled in meanwhile
                    self.results[trial].append(KEYS[key])
                    self.write()
        return True

    def _words(self, trial: Trial, of: int) -> str:
        values = ", ".join(f"{name} {value}" for name, value in zip(self._header[3:-1], trial[3:], strict=True))
        again = ", again, as it was void" if self.results[trial] else ""
        return f"round {trial[0]}, trial {trial[1]} of {of}{again}: run {trial[2]} for {self._limit_s:g} s, {values}"


def _same(one: str, other: str) -> bool:
    try:
        return math.isclose(float(one), float(other), rel_tol=1e-3, abs_tol=1e-6)
    except ValueError:
        return False
