from pathlib import Path

import datasets
import numpy as np
import pytest
from fake_dataset import write_fake

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, STATE
from astra_data.io.importing import from_huggingface

MAPPING = """
name = "again"
task = "walk"
fps = 20
[columns."observation.state"]
fields = ["observation.state"]
[columns.action]
fields = ["action"]
[split]
field = "episode_index"
"""


def test_a_dataset_comes_back_but_for_last_rows_without_a_next_state(tmp_path: Path) -> None:
    fake = write_fake(tmp_path / "fake")
    (tmp_path / "mapping.toml").write_text(MAPPING)
    again = from_huggingface(fake.to_huggingface(), tmp_path / "mapping.toml", out=tmp_path / "out")
    assert again.lengths.tolist() == [length - 1 for length in fake.lengths if length > 1]
    last = np.cumsum(fake.lengths) - 1
    for name, values in fake.columns([STATE, ACTION]).items():
        np.testing.assert_array_equal(again.columns([name])[name], np.delete(values, last, axis=0))
    assert again.reference == "again@data-1.0.0"


def test_rows_that_do_not_fit_are_told(tmp_path: Path) -> None:
    (tmp_path / "mapping.toml").write_text(MAPPING)
    rows = datasets.Dataset.from_dict({"observation.state": [[0.0]], "episode_index": [0]})
    with pytest.raises(BadInputError, match="no field 'action'"):
        from_huggingface(rows, tmp_path / "mapping.toml", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
