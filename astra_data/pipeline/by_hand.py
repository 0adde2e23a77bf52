"""Trials by a person at the robot: a sheet says which policy to run from where, and takes the results."""

import csv
import io
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.durable import write_file
from astra_data.core.errors import BadInputError
from astra_data.worlds.task import Task, names_with_units

KEYS = {"s": "success", "f": "failure", "v": "void"}
QUIT = "q"
Ask = Callable[[str], str]  # given what to do in the next trial, returns one of `KEYS`, or `QUIT` to leave it for later
Trial = tuple[str, ...]  # a line of the sheet before its result: round and number in it, policy, start and goal


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

    def counted(
        self, number: int, candidate: tuple[str, int], predicted: Sequence[float]
    ) -> tuple[list[int], list[float]]:
        """Return a candidate's results of a round that count, 1 or 0, with what is `predicted` of the same starts."""
        row, seed = candidate
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
