import os
import random
import sys
from collections.abc import Collection
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_items import crash, fill_the_disk, touch

from astra_data.core.errors import DiskError
from astra_data.pipeline.executors import Item, Reporter, pickled, run_in_order, run_item
from astra_data.worlds.user_code import user_object


class Workshop:
    """Finishes the oldest running item whenever it is waited for."""

    def __init__(self) -> None:
        self.running: list[str] = []
        self.most = 0
        self.begun: list[str] = []

    def begin(self, item: Item) -> None:
        self.begun.append(item.key)
        self.running.append(item.key)
        self.most = max(self.most, len(self.running))

    def wait(self) -> Collection[str]:
        return [self.running.pop(0)]


def no_call() -> None:
    raise AssertionError("never called")


@pytest.mark.parametrize(("jobs", "most"), [(1, 1), (2, 2), (None, 3)])
def test_items_begin_when_their_inputs_are_finished_and_a_job_is_free(jobs: int | None, most: int) -> None:
    names = {"last": ("a", "b", "c"), "a": ("outside",), "b": (), "c": ()}
    items = [Item(key, inputs, no_call) for key, inputs in names.items()]
    workshop = Workshop()
    run_in_order(items, jobs, workshop.begin, workshop.wait)
    assert workshop.begun == ["a", "b", "c", "last"]
    assert workshop.most == most


def prepared() -> None:
    os.write(1, b"prepared\n")
    os.write(2, b"with care\n")


def test_what_an_item_prints_is_in_its_log_and_an_empty_log_is_removed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    work = pickled(Item("a", (), partial(touch, tmp_path / "made", ())), None)
    seconds = run_item("a", work, tmp_path / "logs/x/y/a.txt", lambda note: None)
    assert isinstance(seconds, float)
    assert 0 < seconds < 60
    assert (tmp_path / "made").exists()
    assert not (tmp_path / "logs/x/y/a.txt").exists()
    log = tmp_path / "logs/b/c.txt"
    error = run_item("b/c", pickled(Item("b/c", (), crash), prepared), log, lambda note: None)
    assert str(error) == f"b/c crashed: ValueError: a bug (traceback: {log})"
    assert log.read_text() == "prepared\nwith care\n"
    os.write(1, b"ours again\n")
    os.write(2, b"and ours\n")
    shown = capfd.readouterr()
    assert "ours again\n" in shown.out
    assert "and ours\n" in shown.err
    assert "with care" not in shown.err


def keep(path: Path, value: float) -> None:
    path.write_text(str(value))


def no_progress(made: partial[None], progress: object) -> None:
    made()


def test_an_item_may_hold_an_object_of_a_file_that_its_preparation_runs(tmp_path: Path) -> None:
    (tmp_path / "sizes.py").write_text("class Size(float):\n    pass\n\n\nSIZE = Size(2.5)\n")
    place = f"{tmp_path / 'sizes.py'}:SIZE"
    size = user_object(place)
    call = partial(no_progress, partial(keep, tmp_path / "kept", size))
    work = pickled(Item("a", (), call), partial(user_object, place))
    del sys.modules[type(size).__module__]  # as in a process of its own
    assert isinstance(run_item("a", work, tmp_path / "log", lambda note: None), float)
    assert (tmp_path / "kept").read_text() == "2.5"


def draw(path: Path, progress: object) -> None:
    drawn = random.random(), float(np.random.random()), float(torch.rand(()))
    path.write_text(f"{drawn}")


def test_what_an_item_draws_depends_on_its_key_alone(tmp_path: Path) -> None:
    """Not on what ran before it in the process, as other rows, or none where a run goes on."""
    keys = ("ground/mine/seed_0", "ground/mine/seed_1", "train/mine/seed_0")
    drawn: dict[str, list[str]] = {key: [] for key in keys}
    for key in (*drawn, *reversed(drawn)):
        work = pickled(Item(key, (), partial(draw, tmp_path / "drawn")), None)
        assert isinstance(run_item(key, work, tmp_path / "log", lambda note: None), float)
        drawn[key].append((tmp_path / "drawn").read_text())
    assert all(first == again for first, again in drawn.values())
    values = [value for first, _ in drawn.values() for value in first.strip("()").split(", ")]
    assert len(set(values)) == 9


def test_at_most_ten_notes_a_second_are_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 5.0
    monkeypatch.setattr("astra_data.pipeline.executors.time.monotonic", lambda: now)
    sent: list[tuple[float, str]] = []
    report = Reporter(sent.append)
    for step in range(12):
        now = 5.0 + step * 0.03
        report(step / 10, "")
    assert [fraction for fraction, _ in sent] == [0.0, 0.4, 0.8]


def err(*, progress: object) -> None:
    raise ValueError("a bug")


def test_a_full_disk_is_no_crash_and_a_full_log_hides_no_error(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "logs/a.txt"
    error = run_item("a", pickled(Item("a", (), fill_the_disk), None), log, lambda note: None)
    assert isinstance(error, DiskError)
    assert str(error).startswith("a: a file cannot be read or written: the disk is full.")
    (tmp_path / "full").symlink_to("/dev/full")
    with capfd.disabled():  # so that the traceback reaches the log
        error = run_item("b", pickled(Item("b", (), err), None), tmp_path / "full", lambda note: None)
    assert "b crashed: ValueError: a bug" in str(error)
