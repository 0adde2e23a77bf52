import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fake_dataset
import numpy as np
import pyarrow.parquet as pq
import pytest
from fake_dataset import COLUMNS, DESCRIPTION, fake_episode, fake_episodes, staged_writer, write_fake, writer
from shared_files import contents

from astra_data.core.errors import BadInputError
from astra_data.dataset import parquet
from astra_data.dataset import statistics as episode_rows
from astra_data.dataset.columns import STATE, Column
from astra_data.dataset.format import DATASET_PATH
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter


def test_the_same_episodes_give_the_same_bytes_in_every_file(tmp_path: Path) -> None:
    write_fake(tmp_path / "one")
    write_fake(tmp_path / "two" / "deeper")
    assert contents(tmp_path / "one") == contents(tmp_path / "two" / "deeper")
    assert sorted(contents(tmp_path / "one")) == [
        "data/chunk-000/file-000.parquet",
        "meta/astra/dataset.json",
        "meta/astra/digests.parquet",
        "meta/astra/episodes.parquet",
        "meta/astra/subsets.json",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    ]


def test_how_it_was_made_is_told_beside_the_content_hash_only(tmp_path: Path) -> None:
    plain = write_fake(tmp_path / "plain")
    with writer(tmp_path / "timed") as open_writer:
        for episode in fake_episodes():
            open_writer.add(episode)
        open_writer.made = {"wall_seconds": 2.5}
    timed = Dataset.open(tmp_path / "timed")
    sums = timed.description["sums"]
    assert timed.description == plain.description | {"wall_seconds": 2.5, "sums": sums}
    assert {path for path in sums if sums[path] != plain.description["sums"][path]} == {DATASET_PATH}
    before, after = contents(plain.root), contents(timed.root)
    assert {name for name in before if before[name] != after[name]} == {"meta/astra/dataset.json"}


def test_one_row_group_per_episode_in_encodings_that_suit_the_values(tmp_path: Path) -> None:
    [path] = write_fake(tmp_path / "set").paths
    metadata = pq.read_metadata(path)
    lengths = [metadata.row_group(group).num_rows for group in range(metadata.num_row_groups)]
    assert lengths == list(fake_dataset.LENGTHS)
    chunks = [metadata.row_group(0).column(index) for index in range(metadata.num_columns)]
    encodings = {chunk.path_in_schema: chunk.encodings for chunk in chunks}
    assert "BYTE_STREAM_SPLIT" in encodings["observation.state.list.element"]
    assert "BYTE_STREAM_SPLIT" in encodings["next.reward"]
    assert "DELTA_BINARY_PACKED" in encodings["mode"]
    assert {chunk.compression for chunk in chunks} == {"SNAPPY"}


def test_another_compression_holds_the_same_values(tmp_path: Path) -> None:
    snappy, zstd = write_fake(tmp_path / "snappy"), write_fake(tmp_path / "zstd", compression="zstd")
    assert pq.read_metadata(zstd.paths[0]).row_group(0).column(0).compression == "ZSTD"
    assert zstd.content_hash == snappy.content_hash
    assert pq.read_table(zstd.paths[0]).equals(pq.read_table(snappy.paths[0]))


def test_files_rotate_when_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = write_fake(tmp_path / "whole")
    monkeypatch.setattr(parquet, "FILE_SIZE_LIMIT", 2_000)
    monkeypatch.setattr(parquet, "CHUNK_SIZE", 2)
    monkeypatch.setattr(episode_rows, "ROWS_AT_ONCE", 2)
    split = write_fake(tmp_path / "split")
    names = [str(path.relative_to(split.root)) for path in split.paths]
    assert names[:3] == [
        f"data/chunk-{at}.parquet" for at in ("000/file-000", "000/file-001", "001/file-000")
    ]
    assert len(list((split.root / "meta/episodes").glob("*/*.parquet"))) == 3
    assert split.verify() == []
    assert split.content_hash == whole.content_hash
    for name in whole.features:
        np.testing.assert_array_equal(whole.columns([name])[name], split.columns([name])[name])


@pytest.mark.parametrize("moment", ["adding", "validating", "renaming"])
def test_a_kill_leaves_nothing_and_the_next_run_succeeds(tmp_path: Path, moment: str) -> None:
    root = tmp_path / "set"
    command = [sys.executable, fake_dataset.__file__, str(root), moment]
    done = subprocess.run(command, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=False)
    assert done.returncode == -signal.SIGKILL
    [left] = tmp_path.iterdir()
    assert left.name.startswith(".set.tmp-")
    assert write_fake(root).verify() == []
    assert list(tmp_path.iterdir()) == [root]


def test_an_exception_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), writer(tmp_path / "set") as open_writer:
        open_writer.add(fake_episode(1, 5))
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    before = contents(write_fake(tmp_path / "set").root)
    with pytest.raises(BadInputError, match="exists already; delete it or choose another"):
        write_fake(tmp_path / "set")
    assert contents(tmp_path / "set") == before


def test_two_writers_do_not_meet(tmp_path: Path) -> None:
    with writer(tmp_path / "set") as first:
        first.add(fake_episode(1, 5))
        with pytest.raises(BadInputError, match="being written right now"), writer(tmp_path / "set"):
            pass
    assert Dataset.open(tmp_path / "set").verify() == []


def test_a_refused_episode_leaves_the_others_alone(tmp_path: Path) -> None:
    with writer(tmp_path / "set") as open_writer:
        for episode in fake_episodes():
            open_writer.add(episode)
            with pytest.raises(BadInputError):
                open_writer.add(episode)
    assert contents(tmp_path / "set") == contents(write_fake(tmp_path / "other").root)


def test_a_dataset_needs_an_episode(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="no episodes"), writer(tmp_path / "set"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_arguments_are_checked_together(tmp_path: Path) -> None:
    columns = [*COLUMNS, Column("index", "int64"), COLUMNS[0]]
    faults = (
        f"{STATE} is given twice; .*index: is filled in by the writer.*; fps 0.*; "
        "compression 'gzip', expected snappy"
    )
    with pytest.raises(BadInputError, match=faults):
        writer(tmp_path / "set", columns=columns, fps=0, compression="gzip")
    faults = "fps 0, expected a positive int; task None, expected text of"
    task: Any = None
    with pytest.raises(BadInputError, match=faults):
        DatasetWriter(tmp_path / "set", COLUMNS, fps=0, task=task, description=DESCRIPTION)
    description = {"name": "a b", "versoin": "1", "parents": [{"name": "x"}], "config": {"x": float("inf")}}
    with pytest.raises(BadInputError) as caught:
        writer(tmp_path / "set", description=description)
    for part in (
        "'a b'",
        "unknown key 'versoin'",
        "stage None",
        "expected name, version and hash",
        "plain JSON",
    ):
        assert part in str(caught.value)


def test_the_dataset_says_where_it_comes_from(tmp_path: Path) -> None:
    raw = write_fake(tmp_path / "raw")
    description = {"name": "fake", "version": "1.1.0", "stage": "pair", "parents": [raw.identity]}
    paired = write_fake(tmp_path / "paired", description=description)
    description = json.loads((paired.root / "meta/astra/dataset.json").read_text())
    assert description["parents"] == [{"name": "fake", "version": "1.0.0", "hash": raw.content_hash}]
    assert paired.reference == "fake@data-1.1.0"
    assert {"python", "astra-data", "lerobot", "mujoco", "numpy"} <= description["packages"].keys()
    assert "git_commit" in description


@pytest.mark.parametrize("make", [writer, staged_writer])
def test_outside_its_block_a_writer_says_so(tmp_path: Path, make: Callable[[Path], DatasetWriter]) -> None:
    made = make(tmp_path / "set")
    with pytest.raises(BadInputError, match=r"inside `with \w+\(\.\.\.\) as writer:`"):
        made.add(fake_episode(1, 4))
    assert list(tmp_path.iterdir()) == []
