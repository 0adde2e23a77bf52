from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.columns import Column, Episode
from astra_data.dataset.format import data_schema
from astra_data.dataset.staging import load_staged, write_staged

COLUMNS = [Column("observation.state", size=3), Column("next.reward"), Column("next.done", "bool")]
EPISODE = Episode(
    7,
    {
        "observation.state": np.arange(12, dtype=np.float32).reshape(4, 3),
        "next.reward": np.array([1.5, 2.5, 3.5, 4.5], np.float32),
        "next.done": np.array([False, False, False, True]),
    },
    {"floor": "carpet"},
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_staged(tmp_path / "000000.arrow", EPISODE, data_schema(COLUMNS))
    return tmp_path / "000000.arrow"


def test_an_episode_comes_back_as_it_was(path: Path) -> None:
    found = load_staged(path, COLUMNS)
    assert (found.uid, found.metadata) == (7, {"floor": "carpet"})
    for name, values in EPISODE.columns.items():
        np.testing.assert_array_equal(found.columns[name], values)
        assert found.columns[name].dtype == values.dtype


def test_one_other_bit_is_told(path: Path) -> None:
    content = bytearray(path.read_bytes())
    at = content.index(EPISODE.columns["next.reward"].tobytes())
    content[at] ^= 1
    path.write_bytes(content)
    with pytest.raises(CorruptDatasetError, match=r"000000\.arrow was altered in next\.reward; delete it"):
        load_staged(path, COLUMNS)


@pytest.mark.parametrize(
    "facts",
    ["[]", "{}", '{"uid": 7, "metadata": {}}', '{"uid": 7, "metadata": {}, "digests": {"none": 1}}', "{"],
)
def test_what_is_no_episode_is_told(tmp_path: Path, facts: str) -> None:
    with pytest.raises(CorruptDatasetError, match="is no whole episode"):
        load_staged(staged_with(tmp_path / "a.arrow", facts), COLUMNS)


def staged_with(path: Path, facts: str) -> Path:
    write_staged(path, EPISODE, data_schema(COLUMNS))
    table = pa.ipc.open_file(path.read_bytes()).read_all().replace_schema_metadata({"episode": facts})
    with pa.ipc.new_file(path, table.schema) as file:
        file.write_table(table)
    return path
