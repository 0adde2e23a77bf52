import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_dataset import concatenated, write_fake

from astra_data.dataset.columns import STATE
from astra_data.dataset.reader import Dataset
from astra_data.io.hub.card import render_card
from astra_data.io.hub.notes import Notes


def test_the_code_that_it_shows_runs(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_fake(tmp_path / "datasets/fake/data-1.0.0")
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "datasets"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("datasets.config.HF_DATASETS_CACHE", tmp_path / "cache")
    ours, _, theirs = python_blocks(render_card(Dataset.open(tmp_path / "datasets/fake/data-1.0.0"), Notes()))
    found: dict[str, Any] = {}
    exec(ours, found)
    np.testing.assert_array_equal(found["values"][STATE], concatenated(STATE))
    exec(theirs, found)
    np.testing.assert_array_equal(np.array(found["rows"][STATE], dtype=np.float32), concatenated(STATE))


def test_a_shared_dataset_is_loaded_from_where_it_is(fake: Dataset) -> None:
    on_hub = render_card(fake, Notes(), source="hf://datasets/me/it")
    assert "astra-data pull hf://datasets/me/it --version 1.0.0" in on_hub
    assert 'LeRobotDataset("me/it", revision="data-1.0.0")' in on_hub
    assert 'load_dataset("me/it", revision="data-1.0.0", split="train")' in on_hub
    elsewhere = render_card(fake, Notes(), source="s3://bucket/fake")
    assert "astra-data pull s3://bucket/fake --version 1.0.0" in elsewhere
    for text in (on_hub, elsewhere):
        for block in python_blocks(text):
            compile(block, "card", "exec")


def python_blocks(text: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)
