"""Run every command that writes on a disk that fails, at each of its operations on files, and run it again.

    uv run python tools/try_failing_disks.py --count 20
    uv run python tools/try_failing_disks.py --commands subset,collect --failures kill,full

What is visible after the failure, and what the same command then comes to, must be what it makes undisturbed.
Prints the faults that were found, with how each is found again, and a table of all trials.
"""

import json
import os
import random
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from disks.failing_disk import FAILURES, FailingDisk, start_over, why_not, workplace
from disks.lost_power import OUTCOMES
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from disks.trials import Result, Trials


def main(
    count: Annotated[int | None, typer.Option(help="Moments per command and failure.", show_default="all")] = None,
    commands: Annotated[str, typer.Option(help="Names, separated by commas.", show_default="all")] = "",
    failures: Annotated[str, typer.Option(help="Names, separated by commas.", show_default="all")] = "",
    at: Annotated[int | None, typer.Option(help="Only this moment.", show_default=False)] = None,
    seed: Annotated[int, typer.Option(help="Of the moments, if not all.")] = 0,
    json_path: Annotated[Path | None, typer.Option("--json", help="Write the figures there.")] = None,
) -> None:
    """Print what was tried and what was found; end with exit code 1 if anything was."""
    if reason := why_not():
        raise SystemExit(f"error: no failing disk here: {reason}")
    memory = Path("/dev/shm")
    os.environ["OMP_NUM_THREADS"] = "1"  # idle threads of a process that forks could block the forked ones
    start_over(lambda: Path(tempfile.mkdtemp(prefix="disks-", dir=memory if memory.is_dir() else None)))
    tally = Tally()
    began = time.perf_counter()
    try:
        for trials in _undisturbed(commands):
            tally.operations[trials.name] = len(trials.undisturbed.operations)
            for way in _chosen(failures, [*FAILURES, *OUTCOMES]):
                for moment in _moments(trials, way, count, at, seed):
                    tally.add(trials.attempt(way, moment))
            seconds = time.perf_counter() - began
            print(f"{trials.name}: {sum(tally.tried.values())} trials so far, {seconds:.0f} s", flush=True)
    finally:
        shutil.rmtree(workplace())
    tally.show()
    if json_path is not None:
        json_path.write_text(json.dumps(tally.report(), indent=1) + "\n")
    raise SystemExit(bool(tally.found))


def _undisturbed(commands: str) -> "Iterator[Trials]":
    """Yield the trials of the commands one after another, those without torch first."""
    # Only in the process that can fail: these import the toolkit.
    from disks import warm  # noqa: PLC0415
    from disks.commands import COMMANDS, make_inputs, write_inputs  # noqa: PLC0415
    from disks.trials import Trials  # noqa: PLC0415

    names = _chosen(commands, list(COMMANDS))
    watched = workplace() / "watched"
    watched.mkdir()
    disk = FailingDisk(watched)
    given = watched / "given"

    def run(line: str) -> None:
        outcome = warm.run(line, workplace())
        assert outcome.status == 0, outcome.printed

    warm.warm_up(light=True)
    assert warm.forked(lambda: write_inputs(given)).status == 0
    make_inputs(given, run, names)
    is_light = True
    for name in sorted(names, key=lambda name: not COMMANDS[name].is_light):
        if is_light and not COMMANDS[name].is_light:
            is_light = False
            warm.warm_up(light=False)
        yield Trials(name, COMMANDS[name], disk, watched)


def _moments(trials: "Trials", way: str, count: int | None, at: int | None, seed: int) -> list[int]:
    """Draw `count` of the moments at which the command can fail in this way, or return `at` alone."""
    first = int(way not in OUTCOMES)
    moments = range(first, first + trials.moments(way))
    if at is not None:
        return [at] if at in moments else []
    if count is None or count >= len(moments):
        return list(moments)
    return sorted(random.Random(seed).sample(moments, count))


def _chosen(given: str, known: list[str]) -> list[str]:
    chosen = given.split(",") if given else known
    if unknown := set(chosen) - set(known):
        raise SystemExit(f"error: unknown: {', '.join(unknown)}; there are {', '.join(known)}")
    return chosen


class Tally:
    """What was tried and found."""

    def __init__(self) -> None:
        self.operations: dict[str, int] = {}
        self.tried: Counter[tuple[str, str]] = Counter()
        self.found: Counter[tuple[str, str, str]] = Counter()

    def add(self, result: "Result") -> None:
        """Count a trial, and print its faults."""
        self.tried[result.command, result.failure] += 1
        for fault, shown in result.faults.items():
            self.found[result.command, result.failure, fault] += 1
            again = f"--commands '{result.command}' --failures '{result.failure}' --at {result.at}"
            print(f"{fault}: {again}: {result.operation}")
            print("    " + shown.strip().replace("\n", "\n    "), flush=True)

    def report(self) -> dict[str, object]:
        """Return the figures, for JSON."""
        trials = [
            {"command": name, "failure": way, "tried": number, **self._faults(name, way)}
            for (name, way), number in self.tried.items()
        ]
        return {"operations": self.operations, "trials": trials}

    def show(self) -> None:
        """Print a table of commands by failures, and the sums."""
        ways = list(dict.fromkeys(way for _, way in self.tried))
        table = Table("command", "operations", *ways)
        for name, number in self.operations.items():
            table.add_row(name, str(number), *(self._cell(name, way) for way in ways))
        sums = [sum(self.tried[name, way] for name in self.operations) for way in ways]
        table.add_row("all", str(sum(self.operations.values())), *map(str, sums))
        console = Console(width=220)
        console.print(table)
        faults: Counter[str] = Counter()
        for (*_, fault), number in self.found.items():
            faults[fault] += number
        told = ", ".join(f"{number} {fault}" for fault, number in faults.items())
        console.print(f"{sum(sums)} trials: {told or 'no faults'}")

    def _faults(self, name: str, way: str) -> dict[str, int]:
        return {fault: n for (*one, fault), n in self.found.items() if one == [name, way]}

    def _cell(self, name: str, way: str) -> str:
        told = [f"{number} {fault}" for fault, number in self._faults(name, way).items()]
        return f"{self.tried[name, way]}" + (f": {', '.join(told)}" if told else "")


if __name__ == "__main__":
    typer.run(main)
