from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_dataset import write_fake

from astra_data.core.errors import BadInputError
from astra_data.dataset import Dataset
from astra_data.dataset.columns import Column
from astra_data.dataset.edit import subset
from astra_data.dataset.versions import Version, home_of, locate, names_at_home, next_version, open_dataset, successor


def versions(*texts: str) -> list[Version]:
    return [Version.parse(text) for text in texts]


def test_versions_order_as_numbers() -> None:
    assert sorted(versions("1.10.0", "1.9.3", "0.0.1")) == versions("0.0.1", "1.9.3", "1.10.0")
    assert str(Version.parse("1.10.0")) == "1.10.0"
    for text in ("1.2", "9" * 5000 + ".0.0"):
        with pytest.raises(BadInputError, match="expected three numbers") as caught:
            Version.parse(text)
        assert len(str(caught.value)) < 200
    assert Version.from_tag("data-" + "9" * 5000 + ".0.0") is None


def test_the_next_version_is_free() -> None:
    taken = versions("1.2.3", "1.4.0", "1.2.7", "3.9.0")
    version = Version.parse("1.2.3")
    assert str(version.next("columns", taken)) == "4.0.0" and str(version.next("episodes", taken)) == "1.5.0"


def test_a_dataset_is_found_by_folder_name_and_version(home: Path, tmp_path: Path) -> None:
    for version in ("1.2.0", "1.10.0"):
        (home / f"ant/data-{version}").mkdir(parents=True)
    (home / "ant/.data-2.0.0.tmp-1").mkdir()
    assert locate("ant") == home / "ant/data-1.10.0"
    assert locate("ant@data-1.2.0") == locate("ant@1.2.0") == home / "ant/data-1.2.0"
    assert locate(str(tmp_path)) == tmp_path


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("ent", "did you mean 'ant'"),
        ("ant@data-9.0.0", "no version data-9.0.0 in .*home; it has data-1.2.0"),
        ("some/where", "no such folder"),
        ("ant@data-" + "9" * 5000 + ".0.0", "no such folder"),
    ],
)
def test_a_missing_dataset_is_refused(home: Path, name: str, fault: str) -> None:
    (home / "ant/data-1.2.0").mkdir(parents=True)
    with pytest.raises(BadInputError, match=fault):
        locate(name)


def test_a_successor_names_its_parent_and_its_place(fake: Dataset, home: Path, tmp_path: Path) -> None:
    description, folder = successor(fake.description, "episodes", stage="subset", config={"count": 2})
    assert description["version"] == "1.1.0" and description["parents"] == [fake.identity]
    assert folder == home_of(description) == home / fake.description["name"] / "data-1.1.0"
    folder.mkdir(parents=True)
    assert successor(fake.description, "episodes", stage="subset", config={})[0]["version"] == "1.2.0"
    elsewhere = successor(fake.description, "episodes", stage="filter", config={}, out=tmp_path / "here")
    assert (elsewhere[0]["version"], elsewhere[1]) == ("1.1.0", tmp_path / "here")
    assert open_dataset(fake.root).reference == fake.reference


def test_the_next_version_has_the_columns_of_its_source_and_more(tmp_path: Path) -> None:
    source, other = write_fake(tmp_path / "first"), write_fake(tmp_path / "other")
    labels: dict[str, Any] = {"stage": "label", "config": {}, "simulator": {"id": "one"}}
    more = [Column("phase")]
    with next_version(
        source, "columns", more=more, subset_seed=3, parents=[other.identity], out=tmp_path / "next", **labels
    ) as writer:
        for episode in source.episodes():
            phase = np.zeros(len(episode), np.float32)
            writer.add(replace(episode, columns={**episode.columns, "phase": phase}))
    written = open_dataset(writer.root)
    assert written.root == tmp_path / "next" and written.schema == [*source.schema, *more]
    assert (written.task, written.info["fps"]) == (source.task, source.info["fps"])
    assert (written.subset_seed, source.subset_seed) == (3, 0)
    assert written.description["parents"] == [source.identity, other.identity]
    assert (written.description["version"], written.description["simulator"]) == ("2.0.0", {"id": "one"})
    again = next_version(source, "columns", out=tmp_path / "again", **labels)
    assert again.root == tmp_path / "again"


def test_a_successor_of_another_name_begins_anew(home: Path, fake: Dataset) -> None:
    asked: dict[str, Any] = {"stage": "subset", "config": {}, "name": "half"}
    description, folder = successor(fake.description, "episodes", **asked)
    assert (description["name"], description["version"]) == ("half", "1.0.0")
    assert description["parents"] == [fake.identity]
    folder.mkdir(parents=True)
    assert successor(fake.description, "episodes", **asked)[0]["version"] == "1.1.0" and names_at_home() == ["half"]


def test_a_name_that_means_a_subset_says_so(home: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_fake(home / "fake/data-1.0.0")
    assert len(open_dataset("fake")) == 5 and caplog.messages == []
    subset(open_dataset("fake"), episodes=2)
    assert len(open_dataset("fake")) == 2
    [message] = caplog.messages
    assert message == "fake is fake@data-1.1.0 here, a subset; the others are fake@data-1.0.0"
    assert len(open_dataset("fake@1.1.0")) == 2 and len(caplog.messages) == 1
