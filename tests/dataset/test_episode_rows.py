import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from astra_data.dataset import statistics as episode_rows
from astra_data.dataset.columns import Column
from astra_data.dataset.statistics import EpisodeRows, episode_statistics

COLUMNS = [Column("state", size=2), Column("flag", "bool")]
LENGTHS = (4, 1, 7)


@pytest.mark.parametrize("rows_at_once", [1, 2, 1000])
def test_rows_locate_the_episodes_and_hold_their_statistics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows_at_once: int
) -> None:
    monkeypatch.setattr(episode_rows, "ROWS_AT_ONCE", rows_at_once)
    rng = np.random.default_rng(0)
    data = [(rng.normal(size=(length, 2)).astype(np.float32), rng.random(length) < 0.5) for length in LENGTHS]
    writer = EpisodeRows(tmp_path, COLUMNS, "walk")
    for number, episode in enumerate(data):
        writer.append(len(episode[0]), chunk=number, file=10 + number, statistics=episode_statistics(episode))
    writer.close()
    path = tmp_path / "meta/episodes/chunk-000/file-000.parquet"
    # No more rows than that are held in memory.
    assert pq.read_metadata(path).num_row_groups == math.ceil(3 / rows_at_once)
    table = pq.read_table(path)
    assert table.column("episode_index").to_pylist() == [0, 1, 2]
    assert table.column("tasks").to_pylist() == [["walk"]] * 3
    assert table.column("length").to_pylist() == list(LENGTHS)
    assert table.column("dataset_from_index").to_pylist() == [0, 4, 5]
    assert table.column("dataset_to_index").to_pylist() == [4, 5, 12]
    assert table.column("data/chunk_index").to_pylist() == [0, 1, 2]
    assert table.column("data/file_index").to_pylist() == [10, 11, 12]
    for row, (state, flag) in zip(table.to_pylist(), data, strict=True):
        assert row["stats/state/count"] == row["stats/flag/count"] == [len(state)]
        np.testing.assert_allclose(row["stats/state/mean"], state.astype(float).mean(0), rtol=1e-12)
        np.testing.assert_allclose(row["stats/state/q90"], np.quantile(state.astype(float), 0.9, axis=0))
        np.testing.assert_allclose(row["stats/flag/mean"], [flag.mean()])
        assert row["stats/flag/max"] == [float(flag.any())]
