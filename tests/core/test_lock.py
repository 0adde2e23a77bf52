import os
import threading
from pathlib import Path

import pytest

from astra_data.core.durable import alone_in, held
from astra_data.core.errors import BadInputError


def test_a_folder_is_held_by_one_at_a_time(tmp_path: Path) -> None:
    with held(tmp_path) as first, held(tmp_path) as second, held(tmp_path / "..") as other:
        assert (first, second, other) == (True, False, True)
    with held(tmp_path) as again:
        assert again


def test_who_waits_gets_the_lock_when_it_is_free(tmp_path: Path) -> None:
    got = threading.Event()

    def wait() -> None:
        with held(tmp_path, wait=True) as ours:
            assert ours
            got.set()

    waiting = threading.Thread(target=wait)
    with held(tmp_path):
        waiting.start()
        assert not got.wait(0.1)
    waiting.join()
    assert got.is_set()


def test_a_pipe_is_locked_without_waiting_for_a_writer(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with held(tmp_path / "pipe") as ours:
        assert ours


def test_a_run_is_alone_in_its_folder_or_told_what_to_do(tmp_path: Path) -> None:
    with (
        alone_in(tmp_path),
        pytest.raises(BadInputError, match=f"^{tmp_path} is in use by another run: wait"),
        alone_in(tmp_path),
    ):
        pytest.fail("two are in the folder")
    with alone_in(tmp_path):
        pass
