import os
import subprocess
import sys
import warnings
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import lerobot_recordings
import pytest
from fake_dataset import NAMES, fake_columns, write_fake
from shared_runs import shared

from astra_data.dataset import format as layout
from astra_data.dataset.columns import Episode
from astra_data.dataset.frames import Frames
from astra_data.dataset.reader import Dataset


@pytest.fixture(scope="session")
def fake(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The fake dataset, for tests that only read it."""
    return write_fake(tmp_path_factory.mktemp("shared") / "set")


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """A fake dataset of the test's own, which it may damage."""
    return write_fake(tmp_path / "set")


@pytest.fixture
def root(dataset: Dataset) -> Path:
    """The folder of `dataset`."""
    return dataset.root


@pytest.fixture
def lonely(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each episode gets a row group of its own."""
    monkeypatch.setattr(layout, "GROUP_ROWS", 1)


@pytest.fixture
def scattered(lonely: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each episode gets a file of its own."""
    monkeypatch.setattr(layout, "FILE_SIZE_LIMIT", 500)


@pytest.fixture(scope="session")
def frames(fake: Dataset) -> Frames:
    return Frames.load(fake, NAMES)


def record(folder: Path) -> None:
    """Write the datasets `a` and `b`, and in one process what `lerobot_recordings` makes."""
    write_fake(folder / "a")
    facts: dict[str, float | int | bool | str] = {"success": False, "return": -1.0, "source_episode": 13}
    lengths = {13: 5, 7: 4}
    write_fake(folder / "b", (Episode(u, fake_columns(lengths[u], seed=u + 100), facts) for u in lengths))
    settings = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(folder / "cache"), "OMP_NUM_THREADS": "1"}
    names = [str(folder), str(folder / "a"), str(folder / "b")]
    command = [sys.executable, lerobot_recordings.__file__, *names]
    subprocess.run(command, env=os.environ | settings, check=True, capture_output=True)


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folders that lerobot wrote, `killed` of a killed writer, and the two datasets behind `merged`."""
    return shared(tmp_path_factory, "recorded", record)


@pytest.fixture(scope="module")
def lerobot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimpleNamespace]:
    """The modules of lerobot that the tests need, with a cache of their own and no network."""
    patch = pytest.MonkeyPatch()
    patch.setenv("HF_HUB_OFFLINE", "1")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        modules = SimpleNamespace(
            package=import_module("lerobot.datasets"),
            features=import_module("lerobot.datasets.feature_utils"),
            dataset=import_module("lerobot.datasets.lerobot_dataset"),
            files=import_module("lerobot.datasets.utils"),
            names=import_module("lerobot.utils.constants"),
        )
    cache = tmp_path_factory.mktemp("cache")
    patch.setattr(import_module("datasets").config, "HF_DATASETS_CACHE", cache)
    yield modules
    patch.undo()
