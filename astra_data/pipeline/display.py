"""Progress of a run: a live line per running item in a terminal, plain lines elsewhere."""

import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, Task, TaskID, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Column
from rich.text import Text

from astra_data.core.progress import Progress as Notes
from astra_data.pipeline.executors import Event, Watch

Then = Callable[[str], object]  # is called with the key of each item that has finished
_BAR_WIDTH = 20
_PACE_S = 120.0  # the pace of the last so many seconds says what time is left


@contextmanager
def display(keys: Collection[str], console: Console, then: Then = lambda _: None) -> Iterator[Watch]:
    """Show the progress of the items of these `keys` on `console`; call `then` with each that has finished."""
    if not console.is_terminal:
        yield _PlainDisplay(keys, console, then)
        return
    columns = (
        _Cropped("{task.description}", markup=False, table_column=Column()),
        BarColumn(_BAR_WIDTH, table_column=Column(width=_BAR_WIDTH)),
        TaskProgressColumn(),
        TimeRemainingColumn(table_column=Column(width=7, no_wrap=True)),
        _Cropped("{task.fields[note]}", markup=False, table_column=Column()),
    )
    with Progress(*columns, console=console, speed_estimate_period=_PACE_S) as progress:
        yield _LiveDisplay(keys, console, then, progress)


class _Cropped(TextColumn):
    """A text of one line, of which the end gives way."""

    def render(self, task: Task) -> Text:
        text = super().render(task)
        text.no_wrap, text.overflow = True, "ellipsis"
        return text


@contextmanager
def shown(key: str) -> Iterator[Notes]:
    """Show the progress of one job of this process on standard error; yield its progress callback."""
    began = time.perf_counter()
    with display([key], Console(stderr=True)) as watch:
        watch(key, None)
        yield lambda fraction, note: watch(key, (fraction, note))
        watch(key, time.perf_counter() - began)


class _PlainDisplay:
    """One line per start, tenth and finish of an item."""

    def __init__(self, keys: Collection[str], console: Console, then: Then) -> None:
        self._total, self._console, self._then = len(keys), console, then
        self._finished, self._tenths = 0, dict.fromkeys(keys, 0)

    def __call__(self, key: str, event: Event) -> None:
        match event:
            case None:
                self._print(f"{key}  started")
            case tuple():
                tenths = int(10 * event[0])
                if tenths > self._tenths[key]:
                    self._tenths[key] = tenths
                    self._print(f"{key}  {10 * tenths} %  {event[1]}")
            case float():
                self._finished += 1
                self._print(f"{key}  finished in {event:.1f} s  ({self._finished} of {self._total})")
                self._then(key)
            case _:
                self._print(f"{key}  failed")

    def _print(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)


class _LiveDisplay(_PlainDisplay):
    """One moving line per running item; finished ones become lines above."""

    def __init__(self, keys: Collection[str], console: Console, then: Then, progress: Progress) -> None:
        super().__init__(keys, console, then)
        self._progress, self._tasks = progress, dict[str, TaskID]()
        self._whole = progress.add_task(f"0 of {self._total} finished", total=self._total, note="")

    def __call__(self, key: str, event: Event) -> None:
        match event:
            case None:
                self._tasks[key] = self._progress.add_task(key, total=1.0, note="starting")
            case tuple():
                self._progress.update(self._tasks[key], completed=event[0], note=event[1])
            case float():
                self._progress.remove_task(self._tasks.pop(key))
                super().__call__(key, event)
            case _ if key in self._tasks:
                self._progress.update(self._tasks[key], note="failed")
        shares = sum(task.completed for task in self._progress.tasks if task.id != self._whole)
        text = f"{self._finished} of {self._total} finished"
        self._progress.update(self._whole, completed=self._finished + shares, description=text)
