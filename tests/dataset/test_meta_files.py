import json
import random
from pathlib import Path
from typing import Any

import pytest
from fake_dataset import write_fake
from nested import places

from astra_data.core.errors import AstraDataError, CorruptDatasetError
from astra_data.dataset.compare import lineage, tree_lines
from astra_data.dataset.description import read_description
from astra_data.dataset.doctor.check import check
from astra_data.dataset.doctor.repair import repair
from astra_data.dataset.edit import subset
from astra_data.dataset.format import DATA_PATH, DATASET_PATH, INFO_PATH, STATS_PATH, SUBSETS_PATH
from astra_data.dataset.inspection import inspect_dataset
from astra_data.dataset.plain import is_data_path
from astra_data.dataset.reader import Dataset

VALUES: tuple[object, ...] = (
    *(None, True, -1, 0, 3, 0.5, 1e300, 10**400, float("nan"), float("inf")),
    *("", "x", "..", "{", "{x}", "/etc/{file_index}", [], [[]], [None], {}, {"x": 1}, {"x": None}),
)


def mutated(content: Any, rng: random.Random) -> Any:  # noqa: ANN401 - JSON
    """Replace or remove something in `content`, rather near its top than deep inside."""
    depth = rng.choice([1, 1, 2, 3, 4])
    *path, last = rng.choice([place for place in places(content) if len(place) <= depth])
    at = content
    for key in path:
        at = at[key]
    if rng.random() < 0.3:
        del at[last]
    else:
        at[last] = rng.choice(VALUES)
    return content


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset with a parent."""
    monkeypatch.setenv("ASTRA_DATA_HOME", str(tmp_path / "home"))
    whole = write_fake(tmp_path / "home/fake/data-1.0.0")
    return subset(whole, episodes=3, out=tmp_path / "set")


@pytest.mark.parametrize("name", [INFO_PATH, STATS_PATH, DATASET_PATH, SUBSETS_PATH])
def test_no_metadata_ends_in_a_traceback(made: Path, name: str) -> None:
    text = (made / name).read_text()
    rng = random.Random(name)
    texts = [json.dumps(mutated(json.loads(text), rng)) for _ in range(60)]
    texts += ["", "{", "[]", "{}", "null", "[[1, 2]]", "9" * 5000, "[" * 20_000, text[:-1]]
    texts += ['{"x": ' + "[" * depth + "]" * depth + "}" for depth in (700, 5000)]
    for changed in texts:
        (made / name).write_text(changed)
        faults = check(made).faults
        try:
            dataset = Dataset.open(made)
            inspect_dataset(dataset)
            list(tree_lines(lineage(dataset)))
        except AstraDataError:
            assert faults, f"validate finds nothing in {changed}"


@pytest.mark.parametrize("name", [INFO_PATH, DATASET_PATH, SUBSETS_PATH])
def test_repair_believes_no_metadata_either(made: Path, tmp_path: Path, name: str) -> None:
    text = (made / name).read_text()
    rng = random.Random(name)
    for number in range(12):
        (made / name).write_text(json.dumps(mutated(json.loads(text), rng)))
        try:
            repair(made, out=tmp_path / f"saved{number}")
        except AstraDataError:
            continue
        assert check(tmp_path / f"saved{number}").faults == []


@pytest.mark.parametrize(
    ("pattern", "is_one"),
    [
        (DATA_PATH, True),
        ("data/{file_index}.parquet", True),
        ("/data/file.parquet", False),
        ("data/../../file.parquet", False),
        ("data/{episode_index}.parquet", False),
        ("data/{file_index.real}.parquet", False),
        ("data/{file_index:999999999d}.parquet", False),
        ("data/{}.parquet", False),
        ("", False),
        (None, False),
    ],
)
def test_data_stays_inside_the_folder(pattern: object, is_one: bool) -> None:
    assert is_data_path(pattern) is is_one


def test_every_fault_of_a_description_is_told_at_once(made: Path) -> None:
    description = json.loads((made / DATASET_PATH).read_text())
    del description["config"]
    parent = {"name": "../x", "version": "1", "hash": "0"}
    changed = description | {"name": "a/b", "parents": [parent], "more": 1}
    (made / DATASET_PATH).write_text(json.dumps(changed))
    with pytest.raises(CorruptDatasetError, match=r"dataset\.json has 4 errors: name: ") as caught:
        read_description(made)
    for key in ("parents.0.name", "parents.0.version", "config: expected a value"):
        assert key in str(caught.value)
