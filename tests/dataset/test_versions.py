from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_dataset import COLUMNS, DESCRIPTION, fake_columns, fake_episode, write_fake, writer

from astra_data.core.errors import BadInputError
from astra_data.dataset import Dataset, DatasetWriter, versions
from astra_data.dataset.columns import ACTION, STATE, Column, Episode
from astra_data.dataset.edit import filter_episodes, merge, subset


def parsed(*texts: str) -> list[versions.Version]:
    return [versions.Version.parse(text) for text in texts]


def test_versions_order_as_numbers() -> None:
    assert sorted(parsed("1.10.0", "1.9.3", "0.0.1")) == parsed("0.0.1", "1.9.3", "1.10.0")
    assert str(versions.Version.parse("1.10.0")) == "1.10.0"
    for text in ("1.2", "9" * 5000 + ".0.0"):
        with pytest.raises(BadInputError, match="expected three numbers") as caught:
            versions.Version.parse(text)
        assert len(str(caught.value)) < 200
    assert versions.Version.from_tag("data-" + "9" * 5000 + ".0.0") is None


def test_the_next_version_is_free() -> None:
    taken = parsed("1.2.3", "1.4.0", "1.2.7", "3.9.0")
    version = versions.Version.parse("1.2.3")
    assert str(version.next("columns", taken)) == "4.0.0" and str(version.next("episodes", taken)) == "1.5.0"


def test_a_dataset_is_found_by_folder_name_and_version(home: Path, tmp_path: Path) -> None:
    for version in ("1.2.0", "1.10.0"):
        (home / f"ant/data-{version}").mkdir(parents=True)
    (home / "ant/.data-2.0.0.tmp-1").mkdir()
    assert versions.locate("ant") == home / "ant/data-1.10.0"
    assert versions.locate("ant@data-1.2.0") == versions.locate("ant@1.2.0") == home / "ant/data-1.2.0"
    assert versions.locate(str(tmp_path)) == tmp_path


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
        versions.locate(name)


def test_a_successor_names_its_parent_and_its_place(fake: Dataset, home: Path, tmp_path: Path) -> None:
    description, folder = versions.successor(fake.description, "episodes", stage="subset", config={"count": 2})
    assert description["version"] == "1.1.0" and description["parents"] == [fake.identity]
    assert folder == versions.home_of(description) == home / fake.description["name"] / "data-1.1.0"
    folder.mkdir(parents=True)
    assert versions.successor(fake.description, "episodes", stage="subset", config={})[0]["version"] == "1.2.0"
    elsewhere = versions.successor(fake.description, "episodes", stage="filter", config={}, out=tmp_path / "here")
    assert (elsewhere[0]["version"], elsewhere[1]) == ("1.1.0", tmp_path / "here")
    assert versions.open_dataset(fake.root).reference == fake.reference


def test_the_next_version_has_the_columns_of_its_source_and_more(tmp_path: Path) -> None:
    source, other = write_fake(tmp_path / "first"), write_fake(tmp_path / "other")
    labels: dict[str, Any] = {"stage": "label", "config": {}, "simulator": {"id": "one"}}
    more = [Column("phase")]
    with versions.next_version(
        source, "columns", more=more, subset_seed=3, parents=[other.identity], out=tmp_path / "next", **labels
    ) as writer:
        for episode in source.episodes():
            phase = np.zeros(len(episode), np.float32)
            writer.add(replace(episode, columns={**episode.columns, "phase": phase}))
    written = versions.open_dataset(writer.root)
    assert written.root == tmp_path / "next" and written.schema == [*source.schema, *more]
    assert (written.task, written.info["fps"]) == (source.task, source.info["fps"])
    assert (written.subset_seed, source.subset_seed) == (3, 0)
    assert written.description["parents"] == [source.identity, other.identity]
    assert (written.description["version"], written.description["simulator"]) == ("2.0.0", {"id": "one"})
    again = versions.next_version(source, "columns", out=tmp_path / "again", **labels)
    assert again.root == tmp_path / "again"


def test_a_successor_of_another_name_begins_anew(home: Path, fake: Dataset) -> None:
    asked: dict[str, Any] = {"stage": "subset", "config": {}, "name": "half"}
    description, folder = versions.successor(fake.description, "episodes", **asked)
    assert (description["name"], description["version"]) == ("half", "1.0.0")
    assert description["parents"] == [fake.identity]
    folder.mkdir(parents=True)
    assert versions.successor(fake.description, "episodes", **asked)[0]["version"] == "1.1.0"
    assert versions.names_at_home() == ["half"]


def test_a_name_that_means_a_subset_says_so(home: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_fake(home / "fake/data-1.0.0")
    assert len(versions.open_dataset("fake")) == 5 and caplog.messages == []
    subset(versions.open_dataset("fake"), episodes=2)
    assert len(versions.open_dataset("fake")) == 2
    [message] = caplog.messages
    assert message == "fake is fake@data-1.1.0 here, a subset; the others are fake@data-1.0.0"
    assert len(versions.open_dataset("fake@1.1.0")) == 2 and len(caplog.messages) == 1


def test_equal_datasets_do_not_differ(tmp_path: Path) -> None:
    found = versions.differences(write_fake(tmp_path / "a"), write_fake(tmp_path / "b"))
    assert found == versions.Differences(schema=[], only_in_a=[], only_in_b=[], values=[], metadata={}, description=[])


def test_every_kind_of_difference_is_told(fake: Dataset, tmp_path: Path) -> None:
    columns = [*COLUMNS[:-1], Column("other", "int64")]
    changed = dict(DESCRIPTION) | {"config": {"episodes": 5, "noise_m": 0.2}, "version": "1.1.0"}
    with writer(tmp_path / "b", columns=columns, fps=10, description=changed) as open_writer:
        for uid, length in ((13, 7), (4, 1), (6, 30), (99, 3)):
            values = dict(fake_columns(length, seed=uid))
            values["other"] = values.pop("mode")
            if uid == 6:
                values[STATE] = values[STATE] + 1
            metadata = dict(fake_episode(uid, length).metadata) | ({"return": 9.0} if uid == 4 else {})
            open_writer.add(Episode(uid, values, metadata))
    found = versions.differences(fake, Dataset.open(tmp_path / "b"))
    assert found.schema == [
        "column mode: only in fake@data-1.0.0",
        "column other: only in fake@data-1.1.0",
        "fps: 20, then 10",
    ]
    assert (found.only_in_a, found.only_in_b) == ([0, 2**53 + 1], [99])
    assert (found.values, found.metadata) == ([6], {"return": [4]})
    assert found.description == ["version: '1.0.0', then '1.1.0'", "config.noise_m: 0.1, then 0.2"]


def test_long_lists_of_the_provenance_are_counted(tmp_path: Path) -> None:
    def made(name: str, recordings: list[str]) -> Dataset:
        description = dict(DESCRIPTION) | {"config": {"recordings": recordings}}
        return write_fake(tmp_path / name, [fake_episode(4, 1)], description=description)

    logs = [f"{number}.csv" for number in range(60)]
    long = made("long", logs)
    for recordings, told in (
        (["other.csv", *logs[1:]], "60 entries, then 60 entries, 1 of them new"),
        (logs[:2], "60 entries, then ['0.csv', '1.csv']"),
        (logs[:5], "60 entries, then ['0.csv', '1.csv', '2.csv', '3.csv', '4.csv']"),
        (logs[:6], "60 entries, then 6 entries, 0 of them new"),
    ):
        other = made(str(len(recordings)), recordings)
        assert versions.differences(long, other).description == [f"config.recordings: {told}"]


pytestmark = pytest.mark.usefixtures("home")


def test_ancestors_are_found_at_home_and_beside(tmp_path: Path) -> None:
    first = write_fake(tmp_path / "home/fake/data-1.0.0")
    left = Dataset.open(filter_episodes(first, without=[13], out=tmp_path / "left"))
    right = Dataset.open(subset(left, episodes=2, seed=4, out=tmp_path / "right"))
    both = Dataset.open(merge([left, right], new_uids=True, out=tmp_path / "both"))
    prints = [dataset.content_hash[:8] for dataset in (both, left, first, right)]
    assert list(versions.tree_lines(versions.lineage(both))) == [
        f"fake@data-1.2.0  {prints[0]}  merge: datasets ['fake@data-1.1.0', 'fake@data-1.2.0'], new_uids True",
        f"├── fake@data-1.1.0  {prints[1]}  filter: without [13]",
        f"│   └── fake@data-1.0.0  {prints[2]}  collect: episodes 5, noise_m 0.1",
        f"└── fake@data-1.2.0  {prints[3]}  subset: episodes 2, seed 4",
        f"    └── fake@data-1.1.0  {prints[1]}  filter: without [13]  (its parents: see above)",
    ]


@pytest.mark.parametrize("place", ["pair/seed_0", "subset/percent_050/seed_0"])
def test_ancestors_are_found_in_the_run(tmp_path: Path, place: str) -> None:
    """In the folders of its other stages, wherever there is a run."""
    first = write_fake(tmp_path / "run/label/seed_0")
    made = Dataset.open(filter_episodes(first, without=[13], out=tmp_path / "run" / place))
    found = f"└── fake@data-1.0.0  {first.content_hash[:8]}  "
    assert list(versions.tree_lines(versions.lineage(made)))[1:] == [f"{found}(not found here)"]
    (tmp_path / "run/recipe.json").write_text("{}")
    assert list(versions.tree_lines(versions.lineage(made)))[1:] == [f"{found}collect: episodes 5, noise_m 0.1"]


def test_an_ancestor_is_known_by_its_hash(tmp_path: Path) -> None:
    first = write_fake(tmp_path / "elsewhere/first")
    made = Dataset.open(filter_episodes(first, without=[13, 4], out=tmp_path / "made"))
    filter_episodes(made, without=[0], out=tmp_path / "home/fake/data-1.0.0")
    [line] = list(versions.tree_lines(versions.lineage(made)))[1:]
    assert line == f"└── fake@data-1.0.0  {first.content_hash[:8]}  (not found here)"


def test_copies_are_counted_as_the_recording_that_they_are_of(tmp_path: Path) -> None:
    sources = {3: None, 8: 3, 5: 8, 9: 7, 7: None}  # 5 is a copy of a part of 3
    columns = fake_episode(0, 3).columns
    facts = {uid: {} if source is None else {"source_episode": source} for uid, source in sources.items()}
    copies = write_fake(tmp_path / "set", (Episode(uid, columns, of) for uid, of in facts.items()))
    assert copies.recordings.tolist() == [0, 0, 0, 1, 1]
    assert write_fake(tmp_path / "plain").recordings.tolist() == [0, 1, 2, 3, 4]


def test_of_a_thousand_merges_of_two_filters_each_is_told_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def described(folder: Path) -> versions.Ancestors:
        name = folder.parent.name
        kind, _, number = name.partition("-")
        parents = [f"{one}-{number}" for one in ("left", "right")] if kind == "merge" else []
        parents = parents or [f"merge-{int(number) - 1}"] * (int(number) > 0)
        made_of = [{"name": name, "version": "1.0.0", "hash": name} for name in parents]
        return {(name, "1.0.0", name): (tmp_path, {"stage": kind, "config": {}, "parents": made_of})}

    monkeypatch.setattr(versions, "_described", described)
    newest = {"name": "merge-1000", "version": "1.0.0", "hash": "merge-1000"}
    [(_, description)] = described(tmp_path / "merge-1000/data-1.0.0").values()  # type: ignore[misc]
    made = versions.lineage(SimpleNamespace(root=tmp_path, identity=newest, description=description))  # type: ignore[arg-type]
    # Of each round two filters, the merge before it once for each of them, and that of the first round.
    assert len(list(versions.tree_lines(made))) == 1 + 1001 * 2 + 1000 * 2 and len(made) == 3 * 1001


def recorded(folder: Path, names: tuple[str, ...] | None, units: list[str] | None = None) -> Dataset:
    astra = None if units is None else {"unit": units}
    columns = [Column(STATE, size=2, names=names, astra=astra), Column(ACTION, names=("throttle",))]
    description = {"name": "logs", "stage": "import"}
    with DatasetWriter(folder, columns, fps=10, task="drive", description=description) as writer:
        writer.add(Episode(0, {STATE: np.zeros((3, 2), np.float32), ACTION: np.zeros(3, np.float32)}))
    return Dataset.open(folder)


@pytest.mark.parametrize(
    ("expected", "faults"),
    [
        (Column(STATE, size=2, names=("x", "v"), astra={"unit": ["m", "m/s"]}), []),
        (Column(STATE, size=2, names=("a", "b")), []),
        (Column(STATE, size=3), ["observation.state has 2 values, expected those of cart: 3"]),
        (Column("force"), ["has no column force"]),
        (
            Column(STATE, size=2, names=("v", "x")),
            ["has the values x, v in observation.state, expected the order v, x"],
        ),
        (
            Column(STATE, size=2, names=("x", "v"), astra={"unit": ["mm", "m/s"]}),
            ["has x of observation.state in m, expected mm: scale it on import"],
        ),
    ],
)
def test_what_contradicts_a_column_is_a_fault(tmp_path: Path, expected: Column, faults: list[str]) -> None:
    logs = recorded(tmp_path / "logs", ("x", "v"), ["m", "m/s"])
    assert versions.column_faults(logs, expected, "cart") == faults


@pytest.mark.parametrize(
    ("names", "expected", "told"),
    [
        (("heading", "north"), ("x", "v"), "heading, north"),
        (("heading", "x"), ("x", "v"), ""),
        (("heading", "north"), None, ""),
        (None, ("x", "v"), "values without names"),
        (None, None, ""),
    ],
)
def test_names_of_which_none_agrees_are_told(
    tmp_path: Path, names: tuple[str, ...] | None, expected: tuple[str, ...] | None, told: str
) -> None:
    logs = recorded(tmp_path / "logs", names)
    columns = [Column(STATE, size=2, names=expected), Column(ACTION, names=("throttle",))]
    text = f"logs@data-1.0.0: takes {told} of observation.state as x, v of cart: check that they are, "
    assert versions.names_apart(logs, columns, "cart") == (f"{text}in this order" if told else "")
