import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
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
    assert "about to crash" in log
    assert "Traceback" in log


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
