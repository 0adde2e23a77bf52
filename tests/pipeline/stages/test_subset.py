from pathlib import Path
from typing import Any

import pytest
from fake_dataset import write_fake

from astra_data.core.errors import BadInputError
from astra_data.core.progress import silent
from astra_data.dataset.reader import Dataset
from astra_data.pipeline.stages.subset import subset


def test_sizes_are_datasets_of_their_own_one_inside_the_other(tmp_path: Path) -> None:
    source = write_fake(tmp_path / "pair")
    uids: set[int] = set()
    for percent, count in ((50, 2), (100, 4), (125, 5)):
        out = tmp_path / str(percent)
        assert subset(tmp_path / "pair", percent=percent, of=4, out=out, progress=silent) == out
        made = Dataset.open(out)
        assert made.verify() == [] and len(made) == count
        assert made.reference == f"fake-percent{percent:03d}@data-1.0.0"
        assert made.description["parents"] == [source.identity] and uids < set(made.uids.tolist())
        uids = set(made.uids.tolist())


def test_episodes_are_never_repeated(tmp_path: Path) -> None:
    write_fake(tmp_path / "pair")
    with pytest.raises(BadInputError, match="has 5 episodes, but the subset has 150 % of 4 = 6"):
        subset(tmp_path / "pair", percent=150, of=4, out=tmp_path / "out", progress=silent)


def test_how_many_there_are_of_how_many_is_told(tmp_path: Path) -> None:
    write_fake(tmp_path / "pair")
    notes = list[str]()
    for of in (None, 4, 2):
        given: dict[str, Any] = {"percent": 100, "of": of, "out": tmp_path / f"{of}"}
        subset(tmp_path / "pair", **given, progress=lambda _, note: notes.append(note))
    assert notes == ["5 of 5 episodes", "4 of 5 episodes", "2 of 5 episodes"]
