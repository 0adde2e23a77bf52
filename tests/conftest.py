import importlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from fake_stages import FakeStages

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch and numpy are loaded: tests run side by side, a core each
os.environ.setdefault("ASTRA_DATA_NO_FSYNC", "1")  # nothing has to survive a power failure, but where that is tested


@pytest.fixture
def fsync(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for the disk, as the package does outside of tests."""
    monkeypatch.setenv("ASTRA_DATA_NO_FSYNC", "")


@pytest.fixture
def disk_order(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What comes to the disk, in its order: "fsync NAME" of files and folders, and "replace"."""
    done, fsync, replace = list[str](), os.fsync, os.replace

    def note_fsync(handle: int) -> None:
        done.append(f"fsync {os.path.basename(os.readlink(f'/proc/self/fd/{handle}'))}")
        fsync(handle)

    def note_replace(source: Path, target: Path) -> None:
        done.append("replace")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", note_fsync)
    monkeypatch.setattr(os, "replace", note_replace)
    return done


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of datasets that are known by name."""
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def quick_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fit failure and scatter models in a few updates, where what they foresee does not matter."""
    importlib.import_module("quick_runs").fit_quickly(monkeypatch)


@pytest.fixture
def forgotten_methods() -> Iterator[None]:
    """Forget afterwards the methods of one's own that a test adds to this process."""
    methods, files, encoders, policies = (
        importlib.import_module(f"astra_data.{name}")
        for name in ("methods", "grounding.files", "grounding.encoder", "policies.learner")
    )
    registered = (methods.METHODS, files.kinds(), encoders.ENCODERS, methods._PLACES, policies.KINDS)
    known = [dict(found) for found in registered]
    yield
    for found, before in zip(registered, known, strict=True):
        found.clear()
        found.update(before)


@pytest.fixture
def stages() -> "Iterator[FakeStages]":
    """Stages that make small artifacts at once."""
    with importlib.import_module("fake_stages").fake_stages() as runs:
        yield runs
