"""Let candidates do the same work in turns, in this process or others, and compare their rates."""

import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass

import psutil
import typer
from rich.console import Console
from rich.table import Table

OURS = "ours"

Stretch = Callable[[], float]
"""Do some work; return how much that was."""
Candidates = dict[str, Stretch]


@dataclass(frozen=True)
class Rate:
    """Work per second: by the clock, and by the processors' time."""

    clock: float
    processor: float


def peer(stack: ExitStack, *command: str) -> Stretch:
    """Start `uv run *command` and have it do some work at each call: a line in, a line with a number out."""
    process = subprocess.Popen(
        ["uv", "run", "--quiet", *command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    stack.enter_context(process)
    assert process.stdin is not None
    assert process.stdout is not None
    given, answered = stack.enter_context(process.stdin), process.stdout

    def stretch() -> float:
        given.write("\n")
        given.flush()
        answer = answered.readline()
        if not answer:
            raise typer.Exit(complain(f"the process ended early: uv run {' '.join(command)}"))
        return float(answer)

    return stretch


def measure(candidates: Candidates, rounds: int) -> dict[str, Rate]:
    """Let the candidates take turns; return the rate of each, after one turn to warm up."""
    done, clock, processor = ({name: 0.0 for name in candidates} for _ in range(3))
    for turn in range(rounds + 1):
        for name, stretch in candidates.items():
            used, began = processor_seconds(), time.perf_counter()
            amount = stretch()
            if turn > 0:
                done[name] += amount
                clock[name] += time.perf_counter() - began
                processor[name] += processor_seconds() - used
    return {name: Rate(done[name] / clock[name], done[name] / processor[name]) for name in candidates}


def processor_seconds() -> float:
    """Return the time that this process and those that it started have kept processors busy."""
    children = [process.cpu_times() for process in psutil.Process().children(recursive=True)]
    return time.process_time() + float(sum(times.user + times.system for times in children))


def print_rates(figures: Mapping[str, Mapping[str, Rate]]) -> None:
    """Print the rates of the candidates for each piece of work, and ours over each of the others'."""
    table = Table("", "per second", "ours is", "per processor second", "ours is")
    for title, rates in figures.items():
        table.add_section()
        table.add_row(f"[bold]{title}")
        ours = rates[OURS]
        for candidate, rate in rates.items():
            cells = [(rate.clock, ours.clock), (rate.processor, ours.processor)]
            words = [word for one, best in cells for word in (f"{one:,.0f}", f"{best / one:,.1f} x")]
            table.add_row(f"  {candidate}", *words)
    Console().print(table)


def complain(message: str) -> int:
    """Print `message` to the error stream; return the exit code."""
    Console(stderr=True).print(message)
    return 1
