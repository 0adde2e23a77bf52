import pytest
from fake_dataset import write_fake
from fake_frames import NAMES

from astra_data.dataset import Dataset
from astra_data.dataset.frames import Frames


@pytest.fixture(scope="session")
def fake(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The fake dataset, for tests that only read it."""
    return write_fake(tmp_path_factory.mktemp("shared") / "set")


@pytest.fixture(scope="session")
def frames(fake: Dataset) -> Frames:
    return Frames.load(fake, NAMES)
