from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from fake_dataset import LENGTHS, concatenated, write_fake

from astra_data.dataset import parquet
from astra_data.dataset.columns import ACTION, STATE
from astra_data.dataset.contents import alterations, measure, read_values
from astra_data.dataset.integrity import digests_of
from astra_data.dataset.reader import Dataset


@pytest.mark.parametrize("block_rows", [1, 20, 2**16])
@pytest.mark.parametrize("group_rows", [4, 13, 1000])
@pytest.mark.parametrize("chosen", [[0, 1, 2, 3, 4], [1, 3], [4]])
def test_blocks_are_whole_episodes_whatever_the_row_groups(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_rows: int, group_rows: int, chosen: list[int]
) -> None:
    monkeypatch.setattr(parquet, "BLOCK_ROWS", block_rows)
    dataset = write_fake(tmp_path / "set")
    [path] = dataset.paths
    pq.write_table(pq.read_table(path), path, row_group_size=group_rows)
    found, values = [], []
    for block, episodes in read_values(dataset, dataset.specs([STATE, "mode"]), np.array(chosen)):
        assert len(block[STATE]) == len(block["mode"]) == sum(LENGTHS[episode] for episode in episodes)
        found += episodes.tolist()
        values.append(block[STATE])
    assert found == chosen
    rows = [row for e in chosen for row in range(dataset.starts[e], dataset.starts[e] + LENGTHS[e])]
    np.testing.assert_array_equal(np.concatenate(values), concatenated(STATE)[rows])


def test_no_columns_are_no_blocks(fake: Dataset) -> None:
    assert list(read_values(fake, [], np.arange(5))) == []


def test_the_measure_is_that_of_the_writer(fake: Dataset) -> None:
    content_hash, digests = measure(fake)
    assert content_hash == fake.content_hash
    assert set(digests) == set(fake.features)
    np.testing.assert_array_equal(
        digests[ACTION], digests_of({ACTION: concatenated(ACTION)}, LENGTHS)[ACTION]
    )


def test_a_sentence_says_file_rows_and_episode(fake: Dataset) -> None:
    [one, two] = alterations(fake, {0: [ACTION], 1: [STATE, ACTION]}, np.array([2, 4]))
    name = "data/chunk-000/file-000.parquet"
    assert one == f"action: other values than were written in {name} rows 8 to 19 (episode 2)"
    sentence = f"other values than were written in {name} rows 50 to 54 (episode 4)"
    assert two == f"observation.state, action: {sentence}"


def test_rows_are_counted_from_the_file_of_the_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parquet, "FILE_SIZE_LIMIT", 500)
    dataset = write_fake(tmp_path / "set")
    assert dataset.file_starts.tolist() == dataset.starts.tolist()  # a file for each episode
    [sentence] = alterations(dataset, {0: [ACTION]}, np.array([2]))
    assert sentence.endswith(f"file-002.parquet rows 0 to {LENGTHS[2] - 1} (episode 2)")
