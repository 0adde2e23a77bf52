from pathlib import Path

import numpy as np
import pytest
from small_run import COLLECT, TASK

from astra_data.columns import (
    ACTION,
    DONE,
    NEXT_STATE,
    REWARD,
    STATE,
    SUCCESS,
    TERMINATED,
    TRUNCATED,
)
from astra_data.dataset import Dataset
from astra_data.errors import BadInputError
from astra_data.progress import silent
from astra_data.stages.collect import CollectConfig, collect

TINY = CollectConfig(episodes=3, max_steps=15)


def test_episodes_are_whole_and_their_steps_follow_each_other(collected: Path) -> None:
    dataset = Dataset.open(collected)
    assert dataset.reference == f"{TASK}-random@data-1.0.0"
    assert len(dataset) == COLLECT.episodes
    for index, episode in enumerate(dataset.episodes()):
        columns = episode.columns
        np.testing.assert_array_equal(columns[NEXT_STATE][:-1], columns[STATE][1:])
        assert np.abs(columns[ACTION]).max() <= 1.0
        ended = columns[TERMINATED] | columns[TRUNCATED]
        assert ended[-1]
        assert not ended[:-1].any()
        np.testing.assert_array_equal(columns[DONE], ended)
        assert columns[TERMINATED][-1] == (len(episode) < COLLECT.max_steps)
        assert dataset.metadata["success"][index] == columns[SUCCESS].any()
        assert dataset.metadata["return"][index] == pytest.approx(columns[REWARD].sum(), abs=1e-4)


def test_commands_are_held_for_a_while(collected: Path) -> None:
    for episode in Dataset.open(collected).episodes([ACTION]):
        changes = np.flatnonzero((np.diff(episode.columns[ACTION], axis=0) != 0).any(axis=1)) + 1
        held = np.diff(changes, prepend=0)
        fewest, most = (round(seconds * 20) for seconds in COLLECT.hold_s)
        assert (held >= fewest).all()
        assert (held <= most).all()


def test_the_seed_decides_everything_and_the_threads_nothing(task: str, tmp_path: Path) -> None:
    hashes, contents = [], []
    for number, (seed, threads) in enumerate([(1, 1), (1, 2), (2, 2)]):
        out = tmp_path / str(number)
        collect(task, TINY, seed=seed, out=out, progress=silent, num_threads=threads)
        hashes.append(Dataset.open(out).content_hash)
        files = [path for path in sorted(out.rglob("*")) if path.is_file() and path.name != "dataset.json"]
        contents.append([path.read_bytes() for path in files])
    assert hashes[0] == hashes[1] != hashes[2]
    assert contents[0] == contents[1] != contents[2]


def test_time_speed_and_machine_are_recorded(collected: Path) -> None:
    dataset = Dataset.open(collected)
    said = dataset.description
    assert 0 < dataset.lengths.sum() / said["target_steps_per_second"] <= said["wall_seconds"]
    assert said["machine"].keys() == {"cpu", "cores", "memory_gib", "gpu"}


def test_an_unknown_task_is_told(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"unknown task 'antmaze-umase': did you mean 'antmaze-umaze'\?"):
        collect("antmaze-umase", TINY, seed=0, out=tmp_path / "out", progress=silent)
