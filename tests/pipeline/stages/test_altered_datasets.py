"""Nothing altered is read of a dataset, and no command makes anything of it."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from damaged import DATA, EPISODES, alter, drop, edit
from numpy.typing import NDArray
from small_run import TASK

from astra_data.cli.sharing import export as export_card
from astra_data.core.errors import CorruptDatasetError
from astra_data.core.progress import silent
from astra_data.dataset.compare import differences
from astra_data.dataset.edit import delete, filter_episodes, merge, subset
from astra_data.dataset.format import DIGESTS_PATH, INFO_PATH, METADATA_PATH
from astra_data.dataset.inspection import inspect_dataset
from astra_data.dataset.reader import Dataset
from astra_data.io.exporters import export
from astra_data.io.hub.sharing import push
from astra_data.pipeline.stages.augment import AugmentConfig, augment
from astra_data.pipeline.stages.pair import PairConfig, pair

Command = Callable[[Path, Path], object]
"""Read a dataset and write to a path."""
Rows = NDArray[np.int64]


def opened(root: Path) -> Dataset:
    return Dataset.open(root)


COMMANDS: dict[str, Command] = {
    "subset": lambda root, out: subset(opened(root), percent=100, out=out),
    "merge": lambda root, out: merge([opened(root), opened(root)], new_uids=True, out=out),
    "delete": lambda root, out: delete(opened(root), [int(opened(root).uids[-1])], out=out),
    "filter": lambda root, out: filter_episodes(opened(root), min_length=1, out=out),
    "augment": lambda root, out: augment(
        TASK, AugmentConfig(episodes=10), dataset=root, seed=0, out=out, progress=silent
    ),
    "pair": lambda root, out: pair(TASK, PairConfig(), dataset=root, out=out, progress=silent),
    "card": lambda root, out: export_card(str(root), format="card", out=out),
    "export": lambda root, out: export(opened(root), out, format="d4rl"),
    "diff": lambda root, _: differences(opened(root), opened(root)),
    "inspect": lambda root, _: inspect_dataset(opened(root)),
    "push": lambda root, out: push(root, f"file://{out}"),
}


def reorder(rows: Callable[[Dataset], Rows]) -> Callable[[Path], None]:
    """Move whole rows of the data file."""

    def change(root: Path) -> None:
        order = rows(opened(root))
        pq.write_table(pq.read_table(root / DATA).take(order), root / DATA)

    return change


def swapped_episodes(dataset: Dataset) -> Rows:
    first, second = dataset.lengths[:2]
    order = np.arange(dataset.lengths.sum())
    return np.concatenate([order[first : first + second], order[:first], order[first + second :]])


def another_unit(root: Path) -> None:
    features = json.loads((root / INFO_PATH).read_text())["features"]
    features["action"]["astra"]["unit"] = ["km"] * features["action"]["shape"][0]
    edit(INFO_PATH, features=features)(root)


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "a value": (alter(DATA, "next.reward", 5, 9.0), rf"next\.reward: other values .* {DATA} rows 0 to \d+ "),
    "two episodes": (reorder(swapped_episodes), r"other values than were written in .*\(episode 0\)"),
    "a success": (alter(METADATA_PATH, "success", 0, None), f"{METADATA_PATH} was altered"),
    "a unit": (another_unit, f"{INFO_PATH} was altered"),
    "no digests": (drop(DIGESTS_PATH), f"{DIGESTS_PATH} missing"),
    "statistics": (alter(EPISODES, "stats/action/q50", 0, [9.0, 9.0]), f"{EPISODES} was altered"),
}


@pytest.fixture
def copied(task: str, collected: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(collected, tmp_path / "set"))


@pytest.mark.parametrize("damage", DAMAGE)
def test_nothing_altered_is_read(damage: str, copied: Path) -> None:
    change, sentence = DAMAGE[damage]
    change(copied)
    with pytest.raises(CorruptDatasetError, match=sentence) as caught:
        list(opened(copied).episodes())
    assert "\n" not in str(caught.value) and "Restore it from a copy" in str(caught.value)


@pytest.mark.parametrize("command", COMMANDS)
def test_nothing_is_made_of_altered_data(command: str, copied: Path) -> None:
    change, sentence = DAMAGE["a value"]
    change(copied)
    with pytest.raises(CorruptDatasetError, match=sentence):
        COMMANDS[command](copied, copied.with_name("made"))
    assert list(copied.parent.iterdir()) == [copied]


def test_other_row_groups_are_no_other_values(copied: Path) -> None:
    pq.write_table(pq.read_table(copied / DATA), copied / DATA, compression="zstd")
    assert len(list(opened(copied).episodes())) == len(opened(copied))
