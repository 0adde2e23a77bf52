"""Nothing altered is read of a dataset, and no command makes anything of it."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from damaged import DATA, alter
from small_run import TASK

from astra_data.cli.sharing import export as export_card
from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.edit import filter_episodes, merge, subset
from astra_data.dataset.inspection import inspect_dataset
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import differences
from astra_data.io.exporters import export
from astra_data.io.hub.sharing import push
from astra_data.pipeline.stages.augment import AugmentConfig, augment
from astra_data.pipeline.stages.pair import pair

Command = Callable[[Path, Path], object]
"""Read a dataset and write to a path."""


def opened(root: Path) -> Dataset:
    return Dataset.open(root)


COMMANDS: dict[str, Command] = {
    "subset": lambda root, out: subset(opened(root), percent=100, out=out),
    "merge": lambda root, out: merge([opened(root), opened(root)], new_uids=True, out=out),
    "filter": lambda root, out: filter_episodes(opened(root), min_length=1, out=out),
    "augment": lambda root, out: augment(TASK, AugmentConfig(episodes=10), dataset=root, out=out),
    "pair": lambda root, out: pair(TASK, dataset=root, out=out),
    "card": lambda root, out: export_card(str(root), format="card", out=out),
    "export": lambda root, out: export(opened(root), out, format="d4rl"),
    "diff": lambda root, _: differences(opened(root), opened(root)),
    "inspect": lambda root, _: inspect_dataset(opened(root)),
    "push": lambda root, out: push(root, f"file://{out}"),
}


@pytest.fixture
def copied(task: str, collected: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(collected, tmp_path / "set"))


def test_episodes_that_changed_places_are_not_read(copied: Path) -> None:
    first, second = opened(copied).lengths[:2]
    table = pq.read_table(copied / DATA)
    swapped = [table.slice(first, second), table.slice(0, first), table.slice(first + second)]
    pq.write_table(pa.concat_tables(swapped), copied / DATA)
    with pytest.raises(CorruptDatasetError, match=r"other values than were written in .*\(episode 0\)"):
        list(opened(copied).episodes())


@pytest.mark.parametrize("command", COMMANDS)
def test_nothing_is_made_of_altered_data(command: str, copied: Path) -> None:
    alter(DATA, "next.reward", 5, 9.0)(copied)
    with pytest.raises(CorruptDatasetError, match=rf"next\.reward: other values .* {DATA} rows 0 to \d+ "):
        COMMANDS[command](copied, copied.with_name("made"))
    assert list(copied.parent.iterdir()) == [copied]


def test_other_row_groups_are_no_other_values(copied: Path) -> None:
    pq.write_table(pq.read_table(copied / DATA), copied / DATA, compression="zstd")
    assert len(list(opened(copied).episodes())) == len(opened(copied))
