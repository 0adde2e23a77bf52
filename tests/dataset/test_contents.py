import itertools
import json
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from damaged import DATA, EPISODES, alter_rows, edit, truncate
from fake_dataset import LENGTHS, fake_episodes, write_fake

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.contents import read_contents
from astra_data.dataset.format import METADATA_PATH
from astra_data.dataset.reader import Dataset


def drop_rows(root: Path) -> None:
    path = root / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(path).slice(0, 50).drop_columns(["action"]), path)


def repeat_the_last_row(root: Path) -> None:
    table = pq.read_table(root / DATA)
    pq.write_table(pa.concat_tables([table, table.slice(54)]), root / DATA)


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (truncate("data/chunk-000/file-000.parquet"), ["file-000.parquet is truncated"]),
        (truncate("meta/episodes/chunk-000/file-000.parquet"), ["file-000.parquet cannot be read"]),
        (truncate("meta/astra/episodes.parquet"), ["episodes.parquet cannot be read"]),
        (truncate("meta/info.json"), ["info.json is no JSON"]),
        (lambda root: (root / "data/chunk-000/file-000.parquet").unlink(), ["file-000.parquet is missing"]),
        (lambda root: (root / "meta/stats.json").unlink(), ["meta/stats.json missing"]),
        (
            lambda root: (root / "meta/episodes/chunk-000/file-000.parquet").unlink(),
            ["meta/episodes has no rows"],
        ),
        (
            edit("meta/info.json", total_frames=54, total_episodes=4),
            ["has 5 episodes, expected 4", "expected 54"],
        ),
        (edit("meta/info.json", codebase_version="v2.1"), ["the format is v2.1, expected v3.0"]),
        (edit("meta/astra/subsets.json", uids=[1, 2]), ["lists other episodes"]),
        (
            lambda root: alter_rows(root / METADATA_PATH, "length", {1: 2}),
            [f"{METADATA_PATH} or meta/astra/subsets.json lists other episodes"],
        ),
        (drop_rows, ["has 50 rows, expected 55", "lacks column action"]),
        (repeat_the_last_row, ["has 56 rows, expected 55"]),
        (
            lambda root: (root / "data/chunk-000/file-001.parquet").write_bytes(b""),
            ["file-001.parquet does not belong"],
        ),
        (
            lambda root: (root / "meta/info.json").write_text('{"codebase_version": "v3.0"}'),
            ["has 5 errors: fps: expected a value", "; features: expected a value"],
        ),
    ],
)
def test_damage_is_told_in_one_line(
    tmp_path: Path, damage: Callable[[Path], object], parts: list[str]
) -> None:
    root = write_fake(tmp_path / "set").root
    damage(root)
    with pytest.raises(CorruptDatasetError) as caught:
        Dataset.open(root)
    message = str(caught.value)
    assert message.startswith(f"{root} is incomplete or was altered: ")
    repair = f"or recover its intact episodes: `astra-data repair {root} --out FOLDER`."
    # Without these, columns and rate are unknown.
    lost = "info.json is no JSON" in message or "features: expected a value" in message
    assert message.endswith("wrote it again." if lost else repair)
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_contents_are_what_was_written(fake: Dataset) -> None:
    contents = read_contents(fake.root)
    episodes = fake_episodes()
    assert contents.uids.tolist() == [episode.uid for episode in episodes]
    assert contents.lengths.tolist() == list(LENGTHS)
    assert contents.starts.tolist() == [0, *itertools.accumulate(LENGTHS[:-1])]
    assert contents.metadata["return"] == [episode.metadata["return"] for episode in episodes]
    assert contents.metadata["source_episode"] == [e.metadata.get("source_episode") for e in episodes]
    assert not {"episode_uid", "length"} & contents.metadata.keys()
    assert contents.paths == [fake.root / DATA]
    assert contents.task == "run"
    listed = json.loads((fake.root / "meta/astra/subsets.json").read_text())["uids"]
    assert [episodes[index].uid for index in contents.order] == listed


def test_data_files_of_other_types_are_refused(tmp_path: Path) -> None:
    root = write_fake(tmp_path / "set").root
    table = pq.read_table(root / DATA)
    at = table.column_names.index("next.reward")
    wide = table.column("next.reward").cast("float64")
    pq.write_table(table.set_column(at, "next.reward", wide).append_column("more", wide), root / DATA)
    with pytest.raises(CorruptDatasetError) as caught:
        read_contents(root)
    for part in ("has next.reward as double, expected float", "has an unknown column more"):
        assert part in str(caught.value)


def test_a_dataset_without_its_task_is_refused(tmp_path: Path) -> None:
    root = write_fake(tmp_path / "set").root
    alter_rows(root / "meta/tasks.parquet", "task_index", {0: 1})
    with pytest.raises(CorruptDatasetError, match=r"tasks\.parquet has no task 0"):
        read_contents(root)


def test_rows_of_other_episodes_are_refused(tmp_path: Path) -> None:
    root = write_fake(tmp_path / "set").root
    alter_rows(root / EPISODES, "dataset_from_index", {1: 8})
    with pytest.raises(CorruptDatasetError, match="adds up to 55 frames, expected 55"):
        read_contents(root)
    alter_rows(root / EPISODES, "dataset_from_index", {1: 7})
    with pytest.raises(CorruptDatasetError, match=r"episodes.* was altered"):
        read_contents(root)
    alter_rows(root / EPISODES, "episode_index", {1: 2})
    with pytest.raises(CorruptDatasetError, match="meta/episodes has 5 episodes"):
        read_contents(root)
