from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fake_dataset import fake_episodes, write_fake

from astra_data.core.errors import BadInputError
from astra_data.dataset.reader import Dataset
from astra_data.pipeline.stages.subset import subset


def test_sizes_are_datasets_of_their_own_one_inside_the_other(tmp_path: Path) -> None:
    source = write_fake(tmp_path / "pair")
    uids: set[int] = set()
    for percent, count in ((50, 2), (100, 4), (125, 5)):
        out = tmp_path / str(percent)
        assert subset(tmp_path / "pair", percent=percent, of=4, out=out) == out
        made = Dataset.open(out)
        assert made.verify() == [] and len(made) == count
        assert made.reference == f"fake-percent{percent:03d}@data-1.0.0"
        assert made.description["parents"] == [source.identity] and uids < set(made.uids.tolist())
        uids = set(made.uids.tolist())


def test_how_many_there_are_of_how_many_is_told(tmp_path: Path) -> None:
    write_fake(tmp_path / "pair")
    notes = list[str]()
    for of in (None, 4, 2):
        given: dict[str, Any] = {"percent": 100, "of": of, "out": tmp_path / f"{of}"}
        subset(tmp_path / "pair", **given, progress=lambda _, note: notes.append(note))
    assert notes == ["5 of 5 episodes", "4 of 5 episodes", "2 of 5 episodes"]


def test_episodes_that_are_marked_as_held_out_are_in_every_size_and_no_part_of_it(tmp_path: Path) -> None:
    marked = (replace(one, metadata={"held_out": index in (1, 3)}) for index, one in enumerate(fake_episodes()))
    held_out = set(write_fake(tmp_path / "pair", marked).uids[[1, 3]].tolist())
    notes = list[str]()
    for percent, others in ((34, 1), (100, 3)):
        out = tmp_path / str(percent)
        subset(tmp_path / "pair", percent=percent, out=out, progress=lambda _, note: notes.append(note))
        uids = set(Dataset.open(out).uids.tolist())
        assert held_out < uids and len(uids) == 2 + others
    assert notes == ["1 of 3 episodes", "3 of 3 episodes"]
    with pytest.raises(BadInputError, match="has 3 episodes, but the subset has 134 % of 3 = 4: expected 1 to 3"):
        subset(tmp_path / "pair", percent=134, out=tmp_path / "out")
