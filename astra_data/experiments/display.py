"""Progress of a run: a live line per running item in a terminal, plain lines elsewhere."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeRemainingColumn

from astra_data.core.progress import Progress as Notes
from astra_data.experiments.execution import Watcher

SECONDS_OF_SPEED = 600
"""Period over which speed is measured to estimate the remaining time."""


@contextmanager
def display(total: int, console: Console, above: RenderableType = "") -> Iterator[Watcher]:
    """Show the progress of `total` items on `console`; in a terminal, below `above`."""
    if not console.is_terminal:
        yield PlainDisplay(total, console)
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
    )
    progress = Progress(*columns, console=console, speed_estimate_period=SECONDS_OF_SPEED)
    with Live(Group(above, progress) if above else progress, console=console):
        yield LiveDisplay(total, progress)


@contextmanager
def shown(key: str) -> Iterator[Notes]:
    """Show the progress of one job of this process on standard error; yield its progress callback."""
    began = time.perf_counter()
    with display(1, Console(stderr=True)) as watch:
        watch.started(key)
        yield partial(watch.progressed, key)
        watch.finished(key, time.perf_counter() - began)


class PlainDisplay:
    """One line per start, tenth and finish of an item."""

    def __init__(self, total: int, console: Console) -> None:
        self._total, self._console = total, console
        self._finished = 0
        self._tenths: dict[str, int] = {}

    def started(self, key: str) -> None:
        """Print that an item has started."""
        self._tenths[key] = 0
        self._print(f"{key}  started")

    def progressed(self, key: str, fraction: float, note: str) -> None:
        """Print the note when another tenth is done."""
        tenths = int(10 * fraction)
        if tenths > self._tenths[key]:
            self._tenths[key] = tenths
            self._print(f"{key}  {10 * tenths} %  {note}")

    def finished(self, key: str, seconds: float) -> None:
        """Print how long the item took."""
        self._finished += 1
        self._print(f"{key}  finished in {seconds:.1f} s  ({self._finished} of {self._total})")

    def failed(self, key: str) -> None:
        """Print that the item has failed."""
        self._print(f"{key}  failed")

    def _print(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)


class LiveDisplay:
    """One moving line per running item; finished ones become lines above."""

    def __init__(self, total: int, progress: Progress) -> None:
        self._total, self._progress = total, progress
        self._finished = 0
        self._whole = progress.add_task(f"0 of {total} finished", total=total, note="")
        self._tasks: dict[str, TaskID] = {}

    def started(self, key: str) -> None:
        """Add the item's line."""
        self._tasks[key] = self._progress.add_task(key, total=1.0, note="starting")

    def progressed(self, key: str, fraction: float, note: str) -> None:
        """Move the item's line on."""
        self._progress.update(self._tasks[key], completed=fraction, note=note)

    def finished(self, key: str, seconds: float) -> None:
        """Replace the item's line by a finished one."""
        self._progress.remove_task(self._tasks.pop(key))
        self._finished += 1
        text = f"{self._finished} of {self._total} finished"
        self._progress.update(self._whole, completed=self._finished, description=text)
        self._progress.console.print(f"{key}  finished in {seconds:.1f} s", markup=False, highlight=False)

    def failed(self, key: str) -> None:
        """Leave the item's line where it stopped, if it had started."""
        if key in self._tasks:
            self._progress.update(self._tasks[key], note="failed")
