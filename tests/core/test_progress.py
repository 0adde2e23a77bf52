import time

import pytest

from astra_data.core.progress import Stopwatch, part


def test_a_part_moves_its_part_of_the_whole() -> None:
    calls: list[tuple[float, str]] = []
    progress = part(lambda fraction, note: calls.append((fraction, note)), 0.5, 0.75, "second  ")
    for fraction in (0.0, 0.5, 1.0):
        progress(fraction, "on it")
    assert calls == [(0.5, "second  on it"), (0.625, "second  on it"), (0.75, "second  on it")]


def test_waiting_takes_wall_time_and_computing_both(monkeypatch: pytest.MonkeyPatch) -> None:
    """Added to what was spent before an interruption."""
    wall, cpu = iter([100.0, 107.0]), iter([20.0, 23.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(wall))
    monkeypatch.setattr(time, "process_time", lambda: next(cpu))
    monkeypatch.setattr(time, "time", lambda: 1e9)
    before = {"wall_seconds": 30.0, "cpu_seconds": 40.0}
    assert Stopwatch(before).spent() == {"wall_seconds": 37.0, "cpu_seconds": 43.0, "finished_at": 1e9}
