"""Progress of a run: a live line per running item in a terminal, plain lines elsewhere."""

import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from datetime import timedelta
from functools import partial
from statistics import fmean

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TaskProgressColumn, TextColumn
from rich.table import Column
from rich.text import Text

from astra_data.core.naming import stage_of_key
from astra_data.core.progress import Progress as Notes
from astra_data.pipeline.executors import Event, Watch

SLOW_STAGES = ("ground", "train", "align")  # until it is known how long these take, no time left is shown
_BAR_WIDTH = 20


@contextmanager
def display(keys: Collection[str], console: Console, then: Callable[[str], object] = lambda _: None) -> Iterator[Watch]:
    """Show the progress of the items of these `keys` on `console`; call `then` with each that has finished."""
    if not console.is_terminal:
        yield _PlainDisplay(keys, console, then)
        return
    columns = (
        _Cropped("{task.description}", markup=False, table_column=Column()),
        BarColumn(_BAR_WIDTH, table_column=Column(width=_BAR_WIDTH)),
        TaskProgressColumn(),
        _TimeLeft(table_column=Column(width=7, no_wrap=True)),
        _Cropped("{task.fields[note]}", markup=False, table_column=Column()),
    )
    with Progress(*columns, console=console) as progress:
        yield _LiveDisplay(keys, console, then, progress)


class _Cropped(TextColumn):
    """A text of one line, of which the end gives way."""

    def render(self, task: Task) -> Text:
        text = super().render(task)
        text.no_wrap, text.overflow = True, "ellipsis"
        return text


class _TimeLeft(ProgressColumn):
    """The time left as the task's field `left` estimates it, a function that returns seconds or None."""

    max_refresh = 0.5

    def render(self, task: Task) -> Text:
        seconds = task.fields["left"]()
        return Text("-:--:--" if seconds is None else str(timedelta(seconds=round(seconds))))


class TimeEstimate:
    """The time that a run of items has left, by how long an item of a stage takes, or what its share done says."""

    def __init__(self, keys: Collection[str], clock: Callable[[], float] = time.monotonic) -> None:
        """Take the `keys` of all items; `clock` returns seconds."""
        self._waiting, self._clock = list(keys), clock
        self._running: dict[str, tuple[float, float]] = {}  # when each began, and its share done
        self._took: list[tuple[str, float]] = []

    def add(self, key: str, event: Event) -> None:
        """Count what happened to an item."""
        match event:
            case None:
                self._waiting.remove(key)
                self._running[key] = (self._clock(), 0.0)
            case tuple():
                self._running[key] = (self._running[key][0], event[0])
            case float():
                del self._running[key]
                self._took.append((key, event))

    def left_of(self, key: str) -> float | None:
        """Return the seconds that a running item has left; None while nothing is known of it."""
        (began, share), now = self._running[key], self._clock()
        whole = (now - began) / share if share else self._means().get(stage_of_key(key))
        return None if whole is None else max(0.0, whole - (now - began))

    def left(self) -> float | None:
        """Return the seconds left of all items, as many at a time as run now; None if not known."""
        means = self._means()
        slow = {stage_of_key(key) for key in (*self._waiting, *self._running)}.intersection(SLOW_STAGES)
        if not means or slow - means.keys():
            return None
        of_running = [self.left_of(key) or 0.0 for key in self._running]
        waiting = sum(means.get(stage_of_key(key), 0.0) for key in self._waiting)
        return max([(sum(of_running) + waiting) / max(1, len(self._running)), *of_running])

    def _means(self) -> dict[str, float]:
        now, found = self._clock(), dict[str, list[float]]()
        running = [(key, (now - began) / share) for key, (began, share) in self._running.items() if share]
        for key, seconds in (*self._took, *running):
            found.setdefault(stage_of_key(key), []).append(seconds)
        return {stage: fmean(seconds) for stage, seconds in found.items()}


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

    def __init__(self, keys: Collection[str], console: Console, then: Callable[[str], object]) -> None:
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

    def __init__(
        self, keys: Collection[str], console: Console, then: Callable[[str], object], progress: Progress
    ) -> None:
        super().__init__(keys, console, then)
        self._progress, self._estimate = progress, TimeEstimate(keys)
        text = f"0 of {self._total} finished"
        self._whole = progress.add_task(text, total=self._total, note="", left=self._estimate.left)
        self._tasks: dict[str, TaskID] = {}

    def __call__(self, key: str, event: Event) -> None:
        self._estimate.add(key, event)
        match event:
            case None:
                left = partial(self._estimate.left_of, key)
                self._tasks[key] = self._progress.add_task(key, total=1.0, note="starting", left=left)
            case tuple():
                self._progress.update(self._tasks[key], completed=event[0], note=event[1])
            case float():
                self._progress.remove_task(self._tasks.pop(key))
                super().__call__(key, event)
                text = f"{self._finished} of {self._total} finished"
                self._progress.update(self._whole, completed=self._finished, description=text)
            case _ if key in self._tasks:
                self._progress.update(self._tasks[key], note="failed")
