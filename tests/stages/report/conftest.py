"""One report over small runs, and the runs of others."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_report import REPLAY, make, task
from fake_runs import write_runs

from astra_data.stages import report as stage


@pytest.fixture(scope="module")
def tasks() -> Iterator[None]:
    """Give the report a task of its own, and no target to replay commands in."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stage, "TASKS", {"antmaze-u": task()})
        patch.setattr(stage, "replay_commands", lambda _: REPLAY)
        yield


@pytest.fixture
def root(tasks: None, tmp_path: Path) -> Path:
    return write_runs(tmp_path)


@pytest.fixture(scope="module")
def folder(tasks: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a finished report, for tests that only read it."""
    root = write_runs(tmp_path_factory.mktemp("report"))
    make(root)
    return root / "report"
