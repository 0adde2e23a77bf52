import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
from fake_dataset import DESCRIPTION, fake_episode, write_fake, writer

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.columns import Episode
from astra_data.dataset.compare import hashes, lineage, recordings_of, tree_lines
from astra_data.dataset.edit import delete, merge, subset
from astra_data.dataset.format import DATASET_PATH
from astra_data.dataset.integrity import sealed
from astra_data.dataset.reader import Dataset

pytestmark = pytest.mark.usefixtures("home")


def test_ancestors_are_found_at_home_and_beside(tmp_path: Path) -> None:
    first = write_fake(tmp_path / "home/fake/data-1.0.0")
    left = Dataset.open(delete(first, [13], out=tmp_path / "left"))
    right = Dataset.open(subset(left, episodes=2, seed=4, out=tmp_path / "right"))
    both = Dataset.open(merge([left, right], new_uids=True, out=tmp_path / "both"))
    prints = [dataset.content_hash[:8] for dataset in (both, left, first, right)]
    assert list(tree_lines(lineage(both))) == [
        f"fake@data-1.2.0  {prints[0]}  merge: "
        "datasets ['fake@data-1.1.0', 'fake@data-1.2.0'], new_uids True",
        f"├── fake@data-1.1.0  {prints[1]}  delete: episodes [13]",
        f"│   └── fake@data-1.0.0  {prints[2]}  collect: episodes 5, noise_m 0.1",
        f"└── fake@data-1.2.0  {prints[3]}  subset: episodes 2, seed 4",
        f"    └── fake@data-1.1.0  {prints[1]}  delete: episodes [13]  (its parents: see above)",
    ]


@pytest.mark.parametrize("place", ["pair/seed_0", "subset/percent_050/seed_0"])
def test_ancestors_are_found_in_the_run(tmp_path: Path, place: str) -> None:
    """In the folders of its other stages, wherever there is a run."""
    first = write_fake(tmp_path / "run/label/seed_0")
    made = Dataset.open(delete(first, [13], out=tmp_path / "run" / place))
    found = f"└── fake@data-1.0.0  {first.content_hash[:8]}  "
    assert list(tree_lines(lineage(made)))[1:] == [f"{found}(not found here)"]
    (tmp_path / "run/recipe.json").write_text("{}")
    assert list(tree_lines(lineage(made)))[1:] == [f"{found}collect: episodes 5, noise_m 0.1"]


def test_an_ancestor_is_known_by_its_hash(tmp_path: Path) -> None:
    first = write_fake(tmp_path / "elsewhere/first")
    made = Dataset.open(delete(first, [13, 4], out=tmp_path / "made"))
    delete(made, [0], out=tmp_path / "home/fake/data-1.0.0")
    [line] = list(tree_lines(lineage(made)))[1:]
    assert line == f"└── fake@data-1.0.0  {first.content_hash[:8]}  (not found here)"


def test_the_same_values_under_another_version_are_no_ancestor(tmp_path: Path) -> None:
    first = write_fake(tmp_path / "elsewhere/first")
    made = Dataset.open(delete(first, [13], out=tmp_path / "made"))
    same = Dataset.open(subset(first, episodes=5, out=tmp_path / "same"))
    assert same.content_hash == first.content_hash
    [line] = list(tree_lines(lineage(made)))[1:]
    assert line.endswith("(not found here)")


def test_copies_are_counted_as_the_recording_that_they_are_of(tmp_path: Path) -> None:
    sources = {3: None, 8: 3, 5: 3, 9: 7, 7: None}
    columns = fake_episode(0, 3).columns
    with writer(tmp_path / "set") as open_writer:
        for uid, source in sources.items():
            open_writer.add(Episode(uid, columns, {} if source is None else {"source_episode": source}))
    assert recordings_of(Dataset.open(tmp_path / "set")).tolist() == [0, 0, 0, 1, 1]
    assert recordings_of(write_fake(tmp_path / "plain")).tolist() == [0, 1, 2, 3, 4]


def test_a_dataset_among_its_own_ancestors_is_told(tmp_path: Path) -> None:
    first = write_fake(tmp_path / "home/fake/data-1.0.0")
    made = Dataset.open(delete(first, [13], out=tmp_path / "made"))
    changed = sealed(first.root, first.description | {"parents": [made.identity]})
    (first.root / DATASET_PATH).write_text(json.dumps(changed))
    with pytest.raises(CorruptDatasetError, match=r"fake@data-1\.1\.0 is among its own ancestors"):
        lineage(made)


def test_an_altered_ancestor_is_not_found(tmp_path: Path) -> None:
    first = write_fake(tmp_path / "home/fake/data-1.0.0")
    made = Dataset.open(delete(first, [13], out=tmp_path / "made"))
    (first.root / DATASET_PATH).write_text(json.dumps(first.description | {"seeds": {"collect": 7}}))
    [line] = list(tree_lines(lineage(made)))[1:]
    assert line.endswith("(not found here)")


def described(
    root: Path, version: int, parents: list[dict[str, str]], description: dict[str, Any]
) -> dict[str, str]:
    """Write the description of a version without its files; return its identity."""
    full = description | {"version": f"1.{version}.0", "parents": parents, "sums": {}}
    own = hashlib.sha256(json.dumps(full, sort_keys=True).encode()).hexdigest()
    folder = root / f"home/fake/data-1.{version}.0" / DATASET_PATH
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.write_text(json.dumps(full | {"sums": {DATASET_PATH: own}}))
    return {"name": "fake", "version": f"1.{version}.0", "hash": full["content_hash"]}


@pytest.mark.parametrize(("versions", "each"), [(1500, 1), (60, 2)])
def test_many_versions_are_told_once_each(tmp_path: Path, versions: int, each: int) -> None:
    """In a chain, and where each was made from the one before it twice over."""
    first = write_fake(tmp_path / "home/fake/data-1.0.0")
    parents = [first.identity] * each
    for version in range(1, versions):
        parents = [described(tmp_path, version, parents, first.description)] * each
    last = Dataset.open(delete(first, [13], out=tmp_path / "last"))
    changed = sealed(last.root, last.description | {"parents": parents})
    (last.root / DATASET_PATH).write_text(json.dumps(changed))
    found = lineage(Dataset.open(last.root))
    lines = list(tree_lines(found))
    assert len(lines) == 1 + versions * each
    assert sum(line.endswith("(its parents: see above)") for line in lines) == (versions - 1) * (each - 1)
    assert hashes(found) == {last.content_hash, first.content_hash}


def test_names_in_a_lineage_control_no_terminal(tmp_path: Path) -> None:
    description = {**DESCRIPTION, "config": {"note\x1b]0;x\x07": "a\nb"}}
    [line] = tree_lines(lineage(write_fake(tmp_path / "set", description=description)))
    assert line.isprintable()
