"""How long work takes, of the clock and of the processor; and when it is time again."""

import time
from collections.abc import Mapping


class Stopwatch:
    """Measure from now on, on top of what was `spent` before an interruption."""

    def __init__(self, spent: Mapping[str, float] | None = None) -> None:
        before = spent or {"wall_seconds": 0.0, "cpu_seconds": 0.0}
        self._wall_began = time.perf_counter() - before["wall_seconds"]
        self._cpu_began = time.process_time() - before["cpu_seconds"]

    @property
    def seconds(self) -> float:
        """Wall-clock time in s."""
        return time.perf_counter() - self._wall_began

    def spent(self) -> dict[str, float]:
        """Return `wall_seconds`, and `cpu_seconds` of all threads of this process."""
        return {"wall_seconds": self.seconds, "cpu_seconds": time.process_time() - self._cpu_began}


class Alarm:
    """Tells when it is time for what is to be done every few `seconds`, such as a checkpoint."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self.reset()

    def reset(self) -> None:
        """Let the time begin anew: what it is for has been done."""
        self._began = time.perf_counter()

    @property
    def rings(self) -> bool:
        """Whether the time is up."""
        return time.perf_counter() - self._began >= self._seconds
