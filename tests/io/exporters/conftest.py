import pytest
from fake_transitions import write_transitions

from astra_data.dataset.reader import Dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_transitions(tmp_path_factory.mktemp("exporters") / "set")
