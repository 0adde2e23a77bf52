import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from astra_data.core import provenance
from astra_data.core.provenance import git_commit, origin

GIT = ("git", "-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return a checkout with one committed file of code."""
    (tmp_path / "astra_data").mkdir()
    for name in ("astra_data/code.py", "pyproject.toml", "uv.lock"):
        (tmp_path / name).write_text("1")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "one")
    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    git_commit.cache_clear()
    yield tmp_path
    git_commit.cache_clear()


def git(folder: Path, *arguments: str) -> str:
    done = subprocess.run([*GIT, "-C", str(folder), *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.mark.parametrize(("changed", "ending"), [("astra_data/new.py", "-dirty"), ("notes.md", "")])
def test_the_commit_is_the_one_that_the_process_began_with(checkout: Path, changed: str, ending: str) -> None:
    """Only changed code makes it dirty."""
    (checkout / changed).write_text("2")
    first = git(checkout, "rev-parse", "HEAD")
    assert git_commit() == first + ending
    git(checkout, "commit", "-q", "--allow-empty", "-m", "two")
    assert git_commit() == first + ending


def test_a_gpu_is_named_where_the_networks_are_on_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"GPU {device}")
    assert origin("cuda:1")["machine"]["gpu"] == "GPU cuda:1" and origin()["machine"]["gpu"] is None
    assert origin()["machine"]["cores"] >= 1


def test_the_memory_is_what_a_container_has_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(provenance, "MEMORY_LIMIT", limit)
    machine = provenance.memory_bytes()
    for text, expected in (("max\n", machine), (f"{2**60}\n", machine), (f"{2**20}\n", 2**20)):
        limit.write_text(text)
        assert provenance.memory_bytes() == expected
        assert provenance.machine()["memory_gib"] == round(expected / 2**30, 1)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system has no affinity")
def test_only_the_cores_that_the_process_may_use_count() -> None:
    code = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
    code += "from astra_data.core.provenance import cores; print(cores())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "1\n"
