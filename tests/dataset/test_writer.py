import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from fake_dataset import (
    COLUMNS,
    DESCRIPTION,
    LENGTHS,
    fake_columns,
    fake_episode,
    fake_episodes,
    staged_writer,
    write_and_be_killed,
    write_fake,
    writer,
)
from forks import forked
from shared_files import contents

from astra_data.core.errors import BadInputError
from astra_data.dataset import Dataset, DatasetWriter
from astra_data.dataset import format as layout
from astra_data.dataset import statistics as episode_rows
from astra_data.dataset.columns import ACTION, DONE, REWARD, STATE, TERMINATED, TRUNCATED, Column, Episode
from astra_data.dataset.format import DATASET_PATH
from astra_data.dataset.writer import Admission


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


def test_how_it_was_made_is_told_beside_the_content_hash_only(fake: Dataset, tmp_path: Path) -> None:
    with writer(tmp_path / "timed") as open_writer:
        for episode in fake_episodes():
            open_writer.add(episode)
        open_writer.made = {"wall_seconds": 2.5}
    timed = Dataset.open(tmp_path / "timed")
    sums = timed.description["sums"]
    assert timed.description == fake.description | {"wall_seconds": 2.5, "sums": sums}
    assert {path for path in sums if sums[path] != fake.description["sums"][path]} == {DATASET_PATH}
    before, after = contents(fake.root), contents(timed.root)
    assert {name for name in before if before[name] != after[name]} == {"meta/astra/dataset.json"}


@pytest.mark.parametrize(
    ("group_rows", "lengths"),
    [(1, LENGTHS), (7, LENGTHS), (8, (8, 12, 30, 5)), (20, (20, 30, 5)), (40, (20, 35)), (2**12, (55,))],
)
def test_small_episodes_share_a_row_group(
    fake: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, group_rows: int, lengths: tuple[int, ...]
) -> None:
    monkeypatch.setattr(layout, "GROUP_ROWS", group_rows)
    dataset = write_fake(tmp_path / "set")
    metadata = pq.read_metadata(dataset.paths[0])
    assert tuple(metadata.row_group(group).num_rows for group in range(metadata.num_row_groups)) == lengths
    assert dataset.content_hash == fake.content_hash
    assert pq.read_table(dataset.paths[0]).equals(pq.read_table(fake.paths[0]))


def test_an_episode_may_be_altered_once_it_is_added(tmp_path: Path) -> None:
    with writer(tmp_path / "set") as open_writer:
        for episode in fake_episodes():
            open_writer.add(episode)
            for values in episode.columns.values():
                values[:] = 0
    assert Dataset.open(tmp_path / "set").content_hash == write_fake(tmp_path / "kept").content_hash


def test_encodings_suit_the_values(fake: Dataset) -> None:
    metadata = pq.read_metadata(fake.paths[0])
    chunks = [metadata.row_group(0).column(index) for index in range(metadata.num_columns)]
    encodings = {chunk.path_in_schema: chunk.encodings for chunk in chunks}
    assert "BYTE_STREAM_SPLIT" in encodings["observation.state.list.element"]
    assert "BYTE_STREAM_SPLIT" in encodings["next.reward"] and "DELTA_BINARY_PACKED" in encodings["mode"]
    assert {chunk.compression for chunk in chunks} == {"SNAPPY"}


@pytest.mark.usefixtures("lonely")
def test_files_rotate_when_full(fake: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layout, "FILE_SIZE_LIMIT", 2_000)
    monkeypatch.setattr(layout, "CHUNK_SIZE", 2)
    monkeypatch.setattr(episode_rows, "ROWS_AT_ONCE", 2)
    split = write_fake(tmp_path / "split")
    names = [str(path.relative_to(split.root)) for path in split.paths]
    assert names[:3] == [f"data/chunk-{at}.parquet" for at in ("000/file-000", "000/file-001", "001/file-000")]
    assert len(list((split.root / "meta/episodes").glob("*/*.parquet"))) == 3 and split.verify() == []
    assert split.content_hash == fake.content_hash
    for name in fake.features:
        np.testing.assert_array_equal(fake.columns([name])[name], split.columns([name])[name])


@pytest.mark.parametrize("moment", ["adding", "validating", "renaming"])
def test_a_kill_leaves_nothing_and_the_next_run_succeeds(tmp_path: Path, moment: str) -> None:
    root = tmp_path / "set"
    assert forked(partial(write_and_be_killed, root, moment)) == -signal.SIGKILL
    [left] = tmp_path.iterdir()
    assert left.name.startswith(".set.tmp-") and write_fake(root).verify() == []
    assert list(tmp_path.iterdir()) == [root]


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
    faults = f"{STATE} is given twice; .*index: is filled in by the writer.*; fps 0"
    with pytest.raises(BadInputError, match=faults):
        writer(tmp_path / "set", columns=columns, fps=0)
    faults = "fps 0, expected a positive int; task None, expected text of"
    task: Any = None
    with pytest.raises(BadInputError, match=faults):
        DatasetWriter(tmp_path / "set", COLUMNS, fps=0, task=task, description=DESCRIPTION)


@pytest.mark.parametrize("make", [writer, staged_writer])
def test_outside_its_block_a_writer_says_so(tmp_path: Path, make: Callable[[Path], DatasetWriter]) -> None:
    made = make(tmp_path / "set")
    with pytest.raises(BadInputError, match=r"inside `with \w+\(\.\.\.\) as writer:`"):
        made.add(fake_episode(1, 4))
    assert list(tmp_path.iterdir()) == []


def test_every_fault_of_a_bad_episode_is_reported_and_nothing_is_written(tmp_path: Path) -> None:
    bad = fake_columns(4, seed=0) | {"extra": np.zeros(4, np.float32), "mode": np.zeros(4, bool)}
    del bad[REWARD]
    bad[ACTION] = np.zeros((4, 3), np.float32)
    with pytest.raises(BadInputError) as caught, writer(tmp_path / "set") as open_writer:
        open_writer.add(fake_episode(1, 5))
        open_writer.add(Episode(1, bad, {"return": 1, "length": 4}))
    message = str(caught.value)
    assert "\n" not in message
    for part in (
        "Episode 1",
        "next.reward: missing",
        "extra: unknown column",
        "action: shape (4, 3), expected (T, 2)",
        "mode: dtype bool, expected int64",
        "metadata return: int, earlier episodes have float",
        "metadata length: is filled in by the writer",
        "same uid",
    ):
        assert part in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "frame", "value", "fault"),
    [
        (DONE, 3, False, "next.done is False in frame 3, expected True: it ends there"),
        (TERMINATED, 0, True, "next.terminated is True in frame 0"),
        (TRUNCATED, 3, False, "next.done is True in frame 3, expected False: terminated or truncated"),
    ],
)
def test_only_the_last_step_ends_an_episode(tmp_path: Path, name: str, frame: int, value: bool, fault: str) -> None:
    columns = fake_columns(4, seed=2)
    columns[name][frame] = value
    with writer(tmp_path / "set") as open_writer:
        open_writer.add(fake_episode(1, 4))
        with pytest.raises(BadInputError, match=fault):
            open_writer.add(Episode(2, columns))


def test_metadata_keys_keep_the_type_of_their_first_value() -> None:
    admission = Admission(COLUMNS)
    admission.keep(Episode(1, fake_columns(3, seed=1), {"success": True}))
    admission.keep(Episode(2, fake_columns(3, seed=2), {"return": 0.5}))
    assert admission.metadata_types == {"success": bool, "return": float}
    with pytest.raises(BadInputError, match="metadata success: int, earlier episodes have bool"):
        admission.check(Episode(3, fake_columns(3, seed=3), {"success": 1}))


@pytest.mark.parametrize(
    ("key", "value", "fault"),
    [
        ("serial", 2**63, "metadata serial: an integer of more than 64 bits"),
        ("serial", -(2**63) - 1, "metadata serial: an integer of more than 64 bits"),
        ("log", "a\ud800", r"metadata log: 'a\\ud800' has characters that are not valid Unicode"),
        ("log", os.fsdecode(b"log\xff.csv"), r"metadata log: 'log\\udcff\.csv' has characters that are not"),
        ("log", "x" * (2**20 + 1), r"metadata log: 1,048,577 characters, expected at most 1,048,576"),
        ("", 1, "metadata '': expected a text of valid characters as its name"),
        ("\udc80", 1, r"metadata '\\udc80': expected a text of valid characters as its name"),
    ],
)
def test_metadata_that_no_file_can_hold_is_refused_when_it_is_added(
    tmp_path: Path, key: str, value: int | str, fault: str
) -> None:
    with writer(tmp_path / "set") as open_writer:
        with pytest.raises(BadInputError, match=fault) as caught:
            open_writer.add(Episode(1, fake_columns(4, seed=1), {key: value}))
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 200
        open_writer.add(Episode(1, fake_columns(4, seed=1), {"log": "x" * 2**20, "serial": 2**63 - 1}))
    assert Dataset.open(tmp_path / "set").metadata["serial"] == [2**63 - 1]
