"""Progress of long jobs."""

import time
from collections.abc import Callable, Mapping

Progress = Callable[[float, str], None]  # called with the fraction done, in [0, 1], and a short note, such as the rate
CLOCKS = ("wall_seconds", "cpu_seconds")  # what is measured: time by the clock, and that of the processor


def silent(fraction: float, note: str) -> None:
    """Report nothing."""


def part(progress: Progress, begin: float, end: float, which: str = "") -> Progress:
    """Return the progress of the part `which` of the job, that covers the fractions `begin` to `end` of the whole."""
    return lambda fraction, note: progress(begin + (end - begin) * fraction, which + note)


class Stopwatch:
    """Measure time from now on, added to the time `spent` before an interruption."""

    def __init__(self, spent: Mapping[str, float] | None = None) -> None:
        before = spent or dict.fromkeys(CLOCKS, 0.0)
        self._wall_began = time.perf_counter() - before["wall_seconds"]
        self._cpu_began = time.process_time() - before["cpu_seconds"]

    @property
    def seconds(self) -> float:
        """Wall-clock time in s."""
        return time.perf_counter() - self._wall_began

    def spent(self) -> dict[str, float]:
        """Return `wall_seconds`, `cpu_seconds` of all threads, and `finished_at`: now, in s since 1970."""
        cpu_seconds = time.process_time() - self._cpu_began
        return {"wall_seconds": self.seconds, "cpu_seconds": cpu_seconds, "finished_at": time.time()}
