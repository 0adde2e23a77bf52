import hashlib
import json
from pathlib import Path

import pytest
from damaged import EPISODES, edit
from fake_dataset import write_fake

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.description import read_description
from astra_data.dataset.format import DATASET_PATH
from astra_data.dataset.integrity import SEALED, altered_files, sealed
from astra_data.dataset.reader import Dataset


def test_the_sums_are_those_of_the_files(tmp_path: Path) -> None:
    dataset = write_fake(tmp_path / "set")
    sums = dict(dataset.description["sums"])
    sums.pop(DATASET_PATH)
    assert sums == {
        path: hashlib.sha256((dataset.root / path).read_bytes()).hexdigest() for path in (*SEALED, EPISODES)
    }
    assert list(altered_files(dataset.root, dataset.description)) == []


@pytest.mark.parametrize("path", [*SEALED, EPISODES])
def test_every_sealed_file_is_known_when_altered_or_missing(path: str, tmp_path: Path) -> None:
    dataset = write_fake(tmp_path / "set")
    with (dataset.root / path).open("ab") as file:
        file.write(b" ")
    assert list(altered_files(dataset.root, dataset.description)) == [path]
    (dataset.root / path).unlink()
    assert list(altered_files(dataset.root, dataset.description)) == [path]


@pytest.mark.parametrize("change", [{"seeds": {}}, {"content_hash": "0" * 64}, {"more": 1}])
def test_the_description_seals_itself(change: dict[str, object], tmp_path: Path) -> None:
    root = write_fake(tmp_path / "set").root
    edit(DATASET_PATH, **change)(root)
    with pytest.raises(CorruptDatasetError, match=r"^meta/astra/dataset\.json was altered$"):
        read_description(root)
    with pytest.raises(CorruptDatasetError, match=r"dataset\.json was altered.*Restore it from a copy"):
        Dataset.open(root)


def test_the_order_of_keys_does_not_matter(tmp_path: Path) -> None:
    dataset = write_fake(tmp_path / "set")
    backwards = dict(reversed(dataset.description.items()))
    (dataset.root / DATASET_PATH).write_text(json.dumps(backwards))
    assert read_description(dataset.root) == dataset.description


def test_what_json_writes_in_another_way_is_sealed_too(tmp_path: Path) -> None:
    root = write_fake(tmp_path / "set").root
    changed = sealed(root, {"config": {2: (1, 0.1)}, "name": "ä"})
    assert changed["config"] == {"2": [1, 0.1]}
    assert json.loads(json.dumps(changed)) == changed
    assert sealed(root, changed | {"sums": {}}) == changed
