import time
from pathlib import Path
from typing import Any

import pytest
import torch

from astra_data.core.checkpoint import CHECKPOINT_SECONDS, Logbook
from astra_data.core.errors import BadInputError


def never(state: dict[str, Any]) -> None:
    raise AssertionError("there was nothing to go on from")


def test_it_goes_on_with_points_time_and_state(tmp_path: Path) -> None:
    checkpoint = tmp_path / "checkpoint.safetensors"
    first = Logbook(checkpoint, never)
    first.points.append({"steps": 3, "loss": None})
    time.sleep(0.01)
    state = {"weight": torch.arange(3.0), "rates": [0.1, 0.2], "done": 7}
    first.keep(state)
    states: list[dict[str, Any]] = []
    second = Logbook(checkpoint, states.append)
    assert second.points == [{"steps": 3, "loss": None}]
    assert second.stopwatch.seconds > 0.01
    (read,) = states
    assert torch.equal(read.pop("weight"), torch.arange(3.0))
    assert read == {"rates": [0.1, 0.2], "done": 7}


def test_what_does_not_fit_is_refused_with_what_to_do(tmp_path: Path) -> None:
    checkpoint = tmp_path / "checkpoint.safetensors"
    Logbook(checkpoint, never).keep({"weight": torch.zeros(2)})
    with pytest.raises(BadInputError, match=f"remove {tmp_path}"):
        Logbook(checkpoint, lambda state: state["bias"])
    checkpoint.write_bytes(checkpoint.read_bytes()[:-4])
    with pytest.raises(BadInputError, match=f"not a complete safetensors file: .*: remove {tmp_path}"):
        Logbook(checkpoint, never)


def test_without_a_file_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Logbook(None, never).keep({"weight": torch.zeros(2)})
    assert not list(tmp_path.iterdir())


def test_a_checkpoint_is_due_a_while_after_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    logbook = Logbook(None, never)
    now[0] += CHECKPOINT_SECONDS - 1.0
    assert not logbook.is_due
    now[0] += 1.0
    assert logbook.is_due
    logbook.keep({})
    assert not logbook.is_due
