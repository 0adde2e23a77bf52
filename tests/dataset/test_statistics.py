import json
import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from damaged import EPISODES
from fake_dataset import concatenated, fake_episodes, write_fake

from astra_data.dataset import statistics
from astra_data.dataset.columns import ACTION, REWARD, STATE, SUCCESS, Array
from astra_data.dataset.doctor.check import check
from astra_data.dataset.format import QUANTILES, STATISTICS
from astra_data.dataset.statistics import episode_statistics, pooled

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
    for name, row in zip(STATISTICS, episode_statistics([values]), strict=True):
        np.testing.assert_allclose(row, expected[name], rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("rows_at_once", [1, 2, 1000])
def test_statistics_of_a_dataset_are_pooled_from_those_of_its_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows_at_once: int
) -> None:
    monkeypatch.setattr(statistics, "ROWS_AT_ONCE", rows_at_once)
    root = write_fake(tmp_path / "set").root
    # No more rows than that are held in memory.
    assert pq.read_metadata(root / EPISODES).num_row_groups == math.ceil(5 / rows_at_once) and not check(root).faults
    stats = json.loads((root / "meta/stats.json").read_text())
    for name in NAMES:
        expected = independent(concatenated(name))
        columns = [episode.columns[name] for episode in fake_episodes()]
        each, steps = [*map(independent, columns)], [*map(len, columns)]
        for key in expected.keys() - {"min", "max", "mean", "std"}:  # an estimate
            expected[key] = np.average([one[key] for one in each], axis=0, weights=steps)
        assert list(stats[name]) == ["min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"]
        assert stats[name].pop("count") == [55]
        for key, values in stats[name].items():
            np.testing.assert_allclose(values, expected[key], rtol=1e-12)
    assert 0.005 < stats[STATE]["std"][1] < 0.02


def test_episode_statistics_are_exact_to_the_precision_of_the_values(root: Path) -> None:
    rows = pq.read_table(root / EPISODES).to_pylist()
    for row, episode in zip(rows, fake_episodes(), strict=True):
        for name in NAMES:
            assert row[f"stats/{name}/count"] == [len(episode)]
            for key, values in independent(episode.columns[name]).items():
                precision = 6e-8 if episode.columns[name].dtype == np.float32 else 1e-12
                np.testing.assert_allclose(row[f"stats/{name}/{key}"], values, rtol=precision)


def test_ranges_of_blocks_are_those_of_the_whole() -> None:
    whole = {name: concatenated(name) for name in NAMES}
    cuts = ((0, 3), (3, 40), (40, 55))
    found = statistics.ranges({name: v[first:end] for name, v in whole.items()} for first, end in cuts)
    for name, values in whole.items():
        expected = independent(values)
        assert found[name].pop("count") == [55] and set(found[name]) == {"min", "max", "mean", "std"}
        for key, value in found[name].items():
            np.testing.assert_allclose(value, expected[key], rtol=1e-12)
    assert statistics.ranges([]) == {}


def test_statistics_of_episodes_are_pooled() -> None:
    rng = np.random.default_rng(0)
    parts = [rng.uniform(size=(count, 3, 1, 1)) for count in (4, 10)]
    each = [
        {key: getattr(np, key)(part, axis=0).tolist() for key in ("min", "max", "mean", "std")} | {"count": [len(part)]}
        for part in parts
    ]
    found, every = pooled(each), np.concatenate(parts)
    for key in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(found[key], getattr(np, key)(every, axis=0))
    assert found["count"] == [14] and pooled([each[0], {}]) == {}
    assert [*found] == ["min", "max", "mean", "std", "count"]  # not as a set orders them, by chance
