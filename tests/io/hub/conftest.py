from collections.abc import Iterator

import pytest
from fake_dataset import write_fake
from fake_hub import TOKEN, Hub, running_hub

from astra_data.dataset.reader import Dataset


@pytest.fixture(scope="session")
def fake(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A finished dataset; not to be changed."""
    return write_fake(tmp_path_factory.mktemp("shared") / "fake")


@pytest.fixture
def quick_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw no figures: it is what takes longest."""
    monkeypatch.setattr("astra_data.reports.figures.style.png", lambda figure: b"\x89PNG")


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    with running_hub() as hub:
        resolve = f"{hub.url}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
        monkeypatch.setattr("huggingface_hub.constants.HUGGINGFACE_CO_URL_TEMPLATE", resolve)
        monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", hub.url)
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_XET", True)
        # Where another test was the first to load it, offline.
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        yield hub
