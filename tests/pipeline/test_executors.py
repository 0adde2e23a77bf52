import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_items import (
    Record,
    crash,
    fail,
    fill_the_disk,
    free_much,
    hang,
    kill_itself,
    leave,
    measure,
    rendezvous,
    touch,
)

from astra_data.core.durable import held
from astra_data.core.errors import AstraDataError, DiskError, MissingStageError
from astra_data.pipeline import executors as local_executor
from astra_data.pipeline.executors import Item, execute, pickled, reporter, run_in_order, run_item
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

    def events(self) -> Collection[tuple[str, float]]:
        return [(self.running.pop(0), 1.0)]


def no_call() -> None:
    raise AssertionError("never called")


@pytest.mark.parametrize(("jobs", "most"), [(1, 1), (2, 2), (None, 3)])
def test_items_begin_when_their_inputs_are_finished_and_a_job_is_free(jobs: int | None, most: int) -> None:
    names = {"last": ("a", "b", "c"), "a": ("outside",), "b": (), "c": ()}
    items = [Item(key, inputs, no_call) for key, inputs in names.items()]
    workshop = Workshop()
    run_in_order(items, jobs, Record(), workshop.begin, workshop.events)
    assert workshop.begun == ["a", "b", "c", "last"] and workshop.most == most


def prepared() -> None:
    os.write(1, b"prepared\n")
    os.write(2, b"with care\n")


def user_call(place: str, *, progress: object) -> None:
    user_object(place)(progress)


def test_what_an_item_prints_is_in_its_log_and_an_empty_log_is_removed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    work = pickled(Item("a", (), partial(touch, tmp_path / "made", ())), None)
    seconds = run_item("a", work, tmp_path / "logs/x/y/a.txt", lambda note: None)
    assert isinstance(seconds, float) and 0 < seconds < 60 and (tmp_path / "made").exists()
    assert not (tmp_path / "logs/x/y/a.txt").exists()
    log = tmp_path / "logs/b/c.txt"
    error = run_item("b/c", pickled(Item("b/c", (), crash), prepared), log, lambda note: None)
    assert str(error) == f"b/c crashed: ValueError: a bug (traceback: {log})"
    assert log.read_text() == "prepared\nwith care\n"
    os.write(1, b"ours again\n")
    os.write(2, b"and ours\n")
    shown = capfd.readouterr()
    assert "ours again\n" in shown.out and "and ours\n" in shown.err and "with care" not in shown.err


def test_a_crash_of_the_users_code_names_its_line(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def METHOD(progress):\n    return 1 / 0\n")
    log, work = tmp_path / "d.txt", partial(user_call, f"{tmp_path}/mine.py:METHOD")
    error = run_item("d", pickled(Item("d", (), work), None), log, lambda note: None)
    assert str(error) == f"d crashed: ZeroDivisionError: division by zero (mine.py, line 2; traceback: {log})"


@pytest.mark.skipif(sys.platform != "linux", reason="measures memory in /proc")
def test_memory_that_an_item_frees_is_given_back(tmp_path: Path) -> None:
    before, after = Item("before", (), partial(measure, tmp_path / "before")), tmp_path / "after"
    freed = Item("freed", ("before",), free_much)
    execute([before, freed, Item("after", ("freed",), partial(measure, after))], logs=tmp_path, watch=Record(), jobs=1)
    pages = [int((tmp_path / name).read_text()) for name in ("before", "after")]
    assert (pages[1] - pages[0]) * os.sysconf("SC_PAGE_SIZE") < 50e6  # of 256 MB


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
    report = reporter(sent.append)
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


PATIENCE_S = 120
"""Enough for a process to start on a machine that is busy with other work."""


def test_an_item_starts_when_its_inputs_are_finished(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    items = [
        Item("b/second", ("a/first",), partial(touch, second, (first,))),
        Item("a/first", ("not/planned",), partial(touch, first, ())),
    ]
    record, before = Record(), signal.getsignal(signal.SIGTERM)
    prepare = partial(Path.write_text, tmp_path / "prepared", "")
    execute(items, jobs=2, logs=tmp_path / "logs", watch=record, prepare=prepare)
    assert (tmp_path / "prepared").exists() and signal.getsignal(signal.SIGTERM) is before
    assert record.events == [
        (event, key) for key in ("a/first", "b/second") for event in ("started", "0.5 half", "finished")
    ]
    assert not [path for path in (tmp_path / "logs").rglob("*") if path.is_file()]


def test_items_run_from_any_thread(tmp_path: Path) -> None:
    place, record, before = tmp_path / "place", Record(), signal.getsignal(signal.SIGINT)
    items = [Item("a", (), partial(touch, place, ()))]
    run = partial(execute, items, jobs=1, logs=tmp_path / "logs", watch=record)
    with ThreadPoolExecutor() as threads:
        threads.submit(run).result(PATIENCE_S)
    assert record.events == [(event, "a") for event in ("started", "0.5 half", "finished")]
    assert place.exists() and signal.getsignal(signal.SIGINT) is before


def test_a_crash_tells_its_last_line_and_where_its_traceback_is(tmp_path: Path) -> None:
    with pytest.raises(AstraDataError, match=r"^a/b crashed: ValueError: a bug \(traceback: .*b\.txt\)$"):
        execute([Item("a/b", (), crash)], jobs=1, logs=tmp_path, watch=Record())
    log = (tmp_path / "a/b.txt").read_text()
    assert "about to crash" in log and "Traceback" in log


@pytest.mark.parametrize(
    ("end", "told"),
    [
        (kill_itself, "a was stopped by SIGKILL, often for want of memory"),
        (leave, "a ended its process with exit code 3"),
    ],
)
def test_a_process_that_ends_is_noticed(end: Callable[..., None], told: str, tmp_path: Path) -> None:
    with pytest.raises(AstraDataError, match=f"^{told}$"):
        execute([Item("a", (), end)], jobs=1, logs=tmp_path, watch=Record())


def test_a_failure_stops_the_others(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    items = [
        Item("hang", (), partial(hang, pid_file)),
        Item("wait", (), partial(rendezvous, tmp_path / "mine", pid_file)),
        Item("fail", ("wait",), fail),
    ]
    with pytest.raises(MissingStageError):
        execute(items, jobs=2, logs=tmp_path / "logs", watch=Record())
    assert _is_gone(int(pid_file.read_text()))


@pytest.mark.skipif(sys.platform != "linux", reason="looks at a process in /proc")
def test_processes_of_items_do_not_notice_ctrl_c(tmp_path: Path) -> None:
    parent = _hanging_run(tmp_path)
    status = Path(f"/proc/{(tmp_path / 'pid').read_text()}/status").read_text()
    parent.send_signal(signal.SIGTERM)
    parent.communicate(timeout=PATIENCE_S)
    blocked = next(line.split()[1] for line in status.splitlines() if line.startswith("SigBlk"))
    assert int(blocked, 16) & 1 << signal.SIGINT - 1


def test_ctrl_c_stops_the_processes(tmp_path: Path) -> None:
    parent = _hanging_run(tmp_path)
    os.killpg(parent.pid, signal.SIGINT)  # as in a terminal, Ctrl-C reaches the whole process group
    _, errors = parent.communicate(timeout=PATIENCE_S)
    assert errors.splitlines().count(b"KeyboardInterrupt") == 1 and _is_gone(int((tmp_path / "pid").read_text()))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_a_run_in_the_background_stops_its_processes(tmp_path: Path, number: signal.Signals) -> None:
    parent = _hanging_run(tmp_path, handler="SIG_IGN")  # a shell that starts a run with "&" has it ignore Ctrl-C
    parent.send_signal(number)
    parent.send_signal(number)
    _, errors = parent.communicate(timeout=PATIENCE_S)
    assert errors.splitlines().count(b"KeyboardInterrupt") == 1 and _is_gone(int((tmp_path / "pid").read_text()))


def test_no_process_outlives_a_killed_run(tmp_path: Path) -> None:
    parent = _hanging_run(tmp_path)
    parent.kill()
    parent.communicate(timeout=PATIENCE_S)
    until = time.monotonic() + PATIENCE_S
    ours = False
    while not ours:
        assert time.monotonic() < until, "the item still holds its lock"
        time.sleep(0.02)
        with held(tmp_path) as ours:
            pass


def _hanging_run(folder: Path, handler: str = "default_int_handler") -> subprocess.Popen[bytes]:
    """Start a process whose one item hangs, holding the lock of `folder`."""
    pid_file, script = folder / "pid", folder / "script.py"
    script.write_text(
        "import signal\nimport sys\nfrom functools import partial\nfrom pathlib import Path\n"
        f"sys.path.insert(0, {str(Path(__file__).parents[1])!r})\n"
        "from fake_items import Record, hang\n"
        "from astra_data.pipeline.executors import Item\n"
        "from astra_data.pipeline.executors import execute\n"
        "if __name__ == '__main__':\n"
        f"    signal.signal(signal.SIGINT, signal.{handler})\n"
        f"    here = Path({str(folder)!r})\n"
        "    execute([Item('a', (), partial(hang, here / 'pid'))], jobs=1, logs=here, watch=Record())\n"
    )
    parent = subprocess.Popen([sys.executable, script], stderr=subprocess.PIPE, start_new_session=True)
    until = time.monotonic() + PATIENCE_S
    while not (pid_file.exists() and pid_file.read_text()):
        if time.monotonic() > until:
            parent.kill()
            pytest.fail("the item did not start")
        time.sleep(0.02)
    return parent


def _is_gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.fixture
def processes(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Processes that were started for items."""
    made, worker = list[object](), local_executor._Worker

    def noted(prepare: Callable[[], object] | None) -> object:
        made.append(worker(prepare))
        return made[-1]

    monkeypatch.setattr(local_executor, "_Worker", noted)
    return made


def test_a_process_runs_one_item_after_another(tmp_path: Path, processes: list[object]) -> None:
    record = Record()
    items = [Item(key, (), partial(touch, tmp_path / key, ())) for key in "ab"]
    with pytest.raises(MissingStageError):
        execute([*items, Item("c", ("b",), fail)], jobs=1, logs=tmp_path / "logs", watch=record)
    assert len(processes) == 1 and record.events[-1] == ("failed", "c")


@pytest.mark.parametrize(("jobs", "most"), [(1, 1), (3, 2)])
def test_processes_for_what_comes_later_start_with_the_first_item(
    jobs: int, most: int, tmp_path: Path, processes: list[object]
) -> None:
    """Two items of the second stage can be made at once, when the only one of the first is there."""
    found = list[int]()
    names = {"first/a": (), "second/b": ("first/a",), "second/c": ("first/a",)}
    items = [Item(key, inputs, partial(touch, tmp_path / key[-1], ())) for key, inputs in names.items()]
    execute(items, jobs=jobs, logs=tmp_path / "logs", watch=lambda key, event: found.append(len(processes)))
    assert found[0] == len(processes) == most
