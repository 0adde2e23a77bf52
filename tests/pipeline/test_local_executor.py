import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest
from fake_items import Record, crash, fail, hang, kill_itself, leave, rendezvous, touch

from astra_data.core.durable import held
from astra_data.core.errors import AstraDataError, MissingStageError
from astra_data.pipeline import executors as local_executor
from astra_data.pipeline.executors import Item, execute

PATIENCE_S = 120
"""Enough for a process to start on a machine that is busy with other work."""


def test_an_item_starts_when_its_inputs_are_finished(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    items = [
        Item("b/second", ("a/first",), partial(touch, second, (first,))),
        Item("a/first", ("not/planned",), partial(touch, first, ())),
    ]
    record = Record()
    execute(items, jobs=2, logs=tmp_path / "logs", watch=record)
    assert record.events == [
        (event, key) for key in ("a/first", "b/second") for event in ("started", "0.5 half", "finished")
    ]
    assert not [path for path in (tmp_path / "logs").rglob("*") if path.is_file()]


def test_independent_items_run_at_the_same_time(tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    items = [Item("one", (), partial(rendezvous, one, two)), Item("two", (), partial(rendezvous, two, one))]
    execute(items, jobs=2, logs=tmp_path / "logs", watch=Record())


def test_items_run_from_any_thread(tmp_path: Path) -> None:
    place, record, before = tmp_path / "place", Record(), signal.getsignal(signal.SIGINT)
    items = [Item("a", (), partial(touch, place, ()))]
    run = partial(execute, items, jobs=1, logs=tmp_path / "logs", watch=record)
    with ThreadPoolExecutor() as threads:
        threads.submit(run).result(PATIENCE_S)
    assert record.events == [(event, "a") for event in ("started", "0.5 half", "finished")]
    assert place.exists() and signal.getsignal(signal.SIGINT) is before


def test_a_reported_error_keeps_its_class_and_names_the_item(tmp_path: Path) -> None:
    with pytest.raises(MissingStageError, match=r"^a/b: nothing to eat$"):
        execute([Item("a/b", (), fail)], jobs=1, logs=tmp_path, watch=Record())
    assert not (tmp_path / "a/b.txt").exists(), "it has no traceback"


def test_a_crash_tells_its_last_line_and_where_its_traceback_is(tmp_path: Path) -> None:
    with pytest.raises(AstraDataError, match=r"^a/b crashed: ValueError: a bug \(traceback: .*b\.txt\)$"):
        execute([Item("a/b", (), crash)], jobs=1, logs=tmp_path, watch=Record())
    log = (tmp_path / "a/b.txt").read_text()
    assert "about to crash" in log
    assert "Traceback" in log


def test_a_killed_process_is_noticed(tmp_path: Path) -> None:
    with pytest.raises(AstraDataError, match=r"^a was stopped by SIGKILL, often for want of memory$"):
        execute([Item("a", (), kill_itself)], jobs=1, logs=tmp_path, watch=Record())


def test_a_process_that_ends_is_noticed(tmp_path: Path) -> None:
    with pytest.raises(AstraDataError, match=r"^a ended its process with exit code 3$"):
        execute([Item("a", (), leave)], jobs=1, logs=tmp_path, watch=Record())


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


def test_ctrl_c_stops_the_processes(tmp_path: Path) -> None:
    parent = _hanging_run(tmp_path)
    # As in a terminal, Ctrl-C reaches the whole process group.
    os.killpg(parent.pid, signal.SIGINT)
    _, errors = parent.communicate(timeout=PATIENCE_S)
    assert errors.splitlines().count(b"KeyboardInterrupt") == 1
    assert _is_gone(int((tmp_path / "pid").read_text()))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_a_run_in_the_background_stops_its_processes(
    tmp_path: Path, number: signal.Signals
) -> None:
    # A shell that starts a run with "&" has it ignore Ctrl-C.
    parent = _hanging_run(tmp_path, handler="SIG_IGN")
    parent.send_signal(number)
    parent.send_signal(number)
    _, errors = parent.communicate(timeout=PATIENCE_S)
    assert errors.splitlines().count(b"KeyboardInterrupt") == 1
    assert _is_gone(int((tmp_path / "pid").read_text()))


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


def test_afterwards_signals_are_handled_as_before(tmp_path: Path) -> None:
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    execute([Item("a", (), partial(touch, tmp_path / "a", ()))], jobs=1, logs=tmp_path, watch=Record())
    assert [signal.getsignal(number) for number in numbers] == before


def test_a_process_runs_one_item_after_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, worker = list[object](), local_executor._Worker

    def noted() -> object:
        made.append(worker())
        return made[-1]

    monkeypatch.setattr(local_executor, "_Worker", noted)
    record = Record()
    items = [Item(key, (), partial(touch, tmp_path / key, ())) for key in "ab"]
    with pytest.raises(MissingStageError):
        execute([*items, Item("c", ("b",), fail)], jobs=1, logs=tmp_path / "logs", watch=record)
    assert len(made) == 1 and record.events[-1] == ("failed", "c")


def test_an_item_is_prepared_in_its_process(tmp_path: Path) -> None:
    prepare = partial(Path.write_text, tmp_path / "before", "")
    item = Item("a", (), partial(touch, tmp_path / "a", (tmp_path / "before",)))
    execute([item], jobs=1, logs=tmp_path / "logs", watch=Record(), prepare=prepare)
