import warnings
from collections.abc import Iterator
from importlib import import_module
from types import SimpleNamespace

import pytest
from fake_dataset import write_fake
from fake_frames import NAMES

from astra_data.dataset.frames import Frames
from astra_data.dataset.reader import Dataset


@pytest.fixture(scope="session")
def fake(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The fake dataset, for tests that only read it."""
    return write_fake(tmp_path_factory.mktemp("shared") / "set")


@pytest.fixture(scope="session")
def frames(fake: Dataset) -> Frames:
    return Frames.load(fake, NAMES)


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
