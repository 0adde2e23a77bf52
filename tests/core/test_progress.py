import time

import pytest

from astra_data.core.progress import Alarm, Stopwatch, part


def test_a_part_moves_its_part_of_the_whole() -> None:
    calls: list[tuple[float, str]] = []
    progress = part(lambda fraction, note: calls.append((fraction, note)), 0.5, 0.75)
    for fraction in (0.0, 0.5, 1.0):
        progress(fraction, "on it")
    assert calls == [(0.5, "on it"), (0.625, "on it"), (0.75, "on it")]


def test_waiting_takes_wall_time_and_computing_both(monkeypatch: pytest.MonkeyPatch) -> None:
    """Added to what was spent before an interruption."""
    wall, cpu = iter([100.0, 107.0]), iter([20.0, 23.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(wall))
    monkeypatch.setattr(time, "process_time", lambda: next(cpu))
    monkeypatch.setattr(time, "time", lambda: 1e9)
    before = {"wall_seconds": 30.0, "cpu_seconds": 40.0}
    assert Stopwatch(before).spent() == {"wall_seconds": 37.0, "cpu_seconds": 43.0, "finished_at": 1e9}


def test_an_alarm_rings_once_its_time_is_up_until_it_is_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([100.0, 159.0, 160.0, 161.0, 170.0, 229.0, 230.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(times))
    alarm = Alarm(60.0)
    assert [alarm.rings for _ in range(3)] == [False, True, True]
    alarm.reset()
    assert [alarm.rings for _ in range(2)] == [False, True]
