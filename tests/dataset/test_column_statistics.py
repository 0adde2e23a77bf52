import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from fake_dataset import concatenated, fake_episodes, write_fake

from astra_data.dataset import statistics as statistics
from astra_data.dataset.columns import ACTION, REWARD, STATE, SUCCESS, Array
from astra_data.dataset.format import QUANTILES, STATISTICS

NAMES = (STATE, ACTION, REWARD, SUCCESS, "mode")


def independent(values: Array) -> dict[str, Array]:
    """Compute LeRobot's statistics with numpy."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    quantiles = {f"q{round(100 * q):02d}": np.quantile(rows, q, axis=0) for q in QUANTILES}
    spread = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    return spread | quantiles


@pytest.mark.parametrize("shape", [(1, 3), (2, 1), (17, 4), (1000, 2)])
def test_statistics_equal_numpy(shape: tuple[int, int]) -> None:
    values = np.random.default_rng(0).normal(100.0, 0.01, size=shape).astype(np.float32)
    expected = independent(values)
    rows = np.array(values.T, dtype=np.float64, order="C")
    for name, row in zip(STATISTICS, statistics.statistics(rows), strict=True):
        np.testing.assert_allclose(row, expected[name], rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("block_values", [1, 100, 2**24])
def test_global_statistics_are_exact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_values: int
) -> None:
    monkeypatch.setattr(statistics, "BLOCK_VALUES", block_values)
    root = write_fake(tmp_path / "set").root
    stats = json.loads((root / "meta/stats.json").read_text())
    for name in NAMES:
        expected = independent(concatenated(name))
        assert list(stats[name]) == ["min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"]
        assert stats[name].pop("count") == [55]
        for key, values in stats[name].items():
            np.testing.assert_allclose(values, expected[key], rtol=1e-12)
    assert 0.005 < stats[STATE]["std"][1] < 0.02


def test_episode_statistics_are_exact(tmp_path: Path) -> None:
    root = write_fake(tmp_path / "set").root
    rows = pq.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for row, episode in zip(rows, fake_episodes(), strict=True):
        for name in NAMES:
            assert row[f"stats/{name}/count"] == [len(episode)]
            for key, values in independent(episode.columns[name]).items():
                np.testing.assert_allclose(row[f"stats/{name}/{key}"], values, rtol=1e-12)


def test_ranges_of_blocks_are_those_of_the_whole() -> None:
    whole = {name: concatenated(name) for name in NAMES}
    cuts = ((0, 3), (3, 40), (40, 55))
    found = statistics.ranges({name: v[first:end] for name, v in whole.items()} for first, end in cuts)
    for name, values in whole.items():
        expected = independent(values)
        assert set(found[name]) == {"min", "max", "mean"}
        for key, value in found[name].items():
            np.testing.assert_allclose(value, expected[key], rtol=1e-12)
    assert statistics.ranges([]) == {}
