"""One command, one failure, one moment: what was visible then, and what the same command made of it."""

import hashlib
import itertools
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from disks import warm
from disks.commands import Command
from disks.failing_disk import COUNTING, FAILURES, FailingDisk, Kind, Operation, read_journal
from disks.lost_power import OUTCOMES, Memory, Outcome

FAULTS = {
    "wrong": "wrong or half values were visible, or reported as finished",
    "lost": "a finished episode was gone",
    "harmed": "an input was altered",
    "traceback": "more or less than one line of error",
    "hang": "no end after two minutes",
    "rerun": "the same command, run again, did not come to the same",
    "left": "hidden files were still there after the rerun",
}


@dataclass
class Undisturbed:
    """A run without failures."""

    look: str
    names: set[str]
    operations: list[Operation]


@dataclass
class Result:
    """The faults that one trial found, each with what showed it."""

    command: str
    failure: str
    at: int
    operation: str
    faults: dict[str, str] = field(default_factory=dict)


class Trials:
    """The trials of one command."""

    def __init__(self, name: str, command: Command, disk: FailingDisk, watched: Path) -> None:
        """Run it undisturbed, to know what it makes and by which operations."""
        self.name, self._command, self._disk = name, command, disk
        self._given, self._folder = watched / "given", watched / "trial"
        self._line = command.line.replace("GIVEN", str(self._given))
        journal = watched.with_name("journal")
        self._begin()
        warm.rehearse(lambda: (warm.command(self._line, self._folder), self._look()))
        self._begin()
        memory = Memory(self._folder)
        outcome = self._run(lambda: disk.arm(COUNTING, journal=journal))
        assert outcome.status == 0, f"{name}: {outcome.printed}"
        look = warm.forked(self._look).answer
        assert look and not look.startswith("damaged"), f"{name}: {look}"
        operations = list(read_journal(journal))
        self.undisturbed = Undisturbed(look, self._names(), operations)
        self._given_before = _digest(self._given)
        memory.replay(operations)
        self._begin(empty=True)
        memory.write(self._folder, None)
        assert warm.forked(self._look).answer == look, f"{name}: something was written past the failing disk"

    def moments(self, failure: str) -> int:
        """Return how many operations can fail in this way, or how many moments there are to lose power at."""
        operations = self.undisturbed.operations
        if failure in OUTCOMES:
            return len(operations) + 1
        return sum(bool(FAILURES[failure].kinds >> operation.kind & 1) for operation in operations)

    def attempt(self, failure: str, at: int) -> Result:
        """Let the `at`-th operation, from 1, fail, and run the command again.

        A power failure comes after `at` operations.
        """
        operations = self.undisturbed.operations
        if failure in OUTCOMES:
            result = Result(self.name, failure, at, _told(operations[at - 1]) if at else "the beginning")
            safe = self._lose_power(failure, at)
            status = None
        else:
            kinds = FAILURES[failure].kinds
            counted = [operation for operation in operations if kinds >> operation.kind & 1]
            result = Result(self.name, failure, at, _told(counted[at - 1]))
            before = itertools.takewhile(lambda op: op is not counted[at - 1], operations)
            safe = {Path(op.other).name for op in before if op.kind is Kind.RENAME}
            self._begin()
            outcome = self._run(lambda: self._disk.arm(FAILURES[failure], at))
            status = outcome.status
            if not (FAILURES[failure].kills and status == -9) and outcome.fault:
                result.faults[outcome.fault] = outcome.printed[-600:] or f"status {status}"
        if _digest(self._given) != self._given_before:
            result.faults["harmed"] = "the inputs differ"
        self._judge(result, status, {name for name in safe if name.endswith(".arrow")})
        return result

    def _judge(self, result: Result, status: int | None, safe: set[str]) -> None:
        names = {path.name for path in self._folder.rglob("*.arrow")}
        found = warm.forked(self._look_and_run_again)
        if found.answer is None:
            result.faults[found.fault or "rerun"] = found.printed[-600:]
            return
        first, runs = found.answer
        wanted = self.undisturbed.look
        if first not in (None, wanted) or (status == 0 and first is None):
            result.faults["wrong"] = f"exit code {status}, visible: {first}"
        if safe - names and first is None:
            result.faults["lost"] = f"{sorted(safe - names)}"
        for run in runs:
            if run["look"] not in (None, wanted) and run["code"] == 0:
                result.faults["wrong"] = f"rerun: {run}"
            is_refusal = run["present"] and run["code"] == 1 and "exists already" in run["printed"]
            if run["look"] != wanted or not (run["code"] == 0 or is_refusal):
                result.faults["rerun"] = f"{run}"
            if "Traceback" in run["printed"]:
                result.faults["traceback"] = f"rerun: {run['printed'][-600:]}"
        left = self._names() - self.undisturbed.names
        if left and "rerun" not in result.faults:
            result.faults["left"] = f"{sorted(left)}"

    def _look_and_run_again(self) -> tuple[str | None, list[dict[str, Any]]]:
        """Describe what there is, and run the command again: with the target as it is, and without it."""
        first, runs = self._look(), []
        if first is not None:
            runs.append(self._rerun(present=True))
        if first is None or not self._command.adds:
            _remove(self._folder / self._command.target)
            runs.append(self._rerun(present=False))
        return first, runs

    def _rerun(self, *, present: bool) -> dict[str, Any]:
        code, printed = warm.caught(lambda: warm.command(self._line, self._folder))
        return {"present": present, "code": code, "look": self._look(), "printed": printed[-1000:]}

    def _run(self, before: Callable[[], object]) -> warm.Outcome:
        outcome = warm.run(self._line, self._folder, before)
        self._disk.disarm()
        return outcome

    def _lose_power(self, failure: Outcome | str, at: int) -> set[str]:
        """Leave what a power failure after `at` operations does; return the files that were safe by then."""
        self._begin()
        memory = Memory(self._folder)
        memory.replay(self.undisturbed.operations[:at])
        self._begin(empty=True)
        memory.write(self._folder, failure)  # type: ignore[arg-type]
        return memory.synced_names()

    def _begin(self, *, empty: bool = False) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir()
        if self._command.prepare and not empty:
            self._command.prepare(self._given, self._folder)

    def _look(self) -> str | None:
        return self._command.look(self._folder / self._command.target)

    def _names(self) -> set[str]:
        """Return the paths in the folder of the command, but for logs."""
        paths = {path.relative_to(self._folder).as_posix() for path in self._folder.rglob("*")}
        return {path for path in paths if "/logs/" not in f"{path}/"}


def _told(operation: Operation) -> str:
    path = re.sub(r"tmp-\d+", "tmp", operation.path.partition("/watched/")[2])
    return f"{operation.kind.name.lower()} {path}"


def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        digest.update(str(path).encode() + (path.read_bytes() if path.is_file() else b""))
    return digest.hexdigest()


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
