import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_dataset import COLUMNS, DESCRIPTION, assert_same, fake_episode, write_fake, writer

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import REWARD, STATE, Column, Episode
from astra_data.dataset.edit import filter_episodes, merge, share, subset
from astra_data.dataset.reader import Dataset


def write(root: Path, uids: range) -> Dataset:
    return write_fake(root, (fake_episode(uid, 2 + uid % 5) for uid in uids))


@pytest.fixture(scope="module")
def forty(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write(tmp_path_factory.mktemp("edit") / "forty", range(40))


def uids(root: Path) -> set[int]:
    return set(Dataset.open(root).uids.tolist())


def assert_taken_over(source: Dataset, root: Path) -> None:
    """The new dataset is whole, and its episodes are those of `source`, in the same order."""
    made = Dataset.open(root)
    assert made.verify() == []
    episodes = {episode.uid: episode for episode in source.episodes()}
    assert [uid for uid in source.uids.tolist() if uid in uids(root)] == made.uids.tolist()
    assert_same(made.episodes(), [episodes[uid] for uid in made.uids.tolist()])


def test_subsets_are_nested_and_described(forty: Dataset, tmp_path: Path) -> None:
    folders = [subset(forty, percent=percent, out=tmp_path / f"{percent}", seed=3) for percent in (25, 50, 100)]
    assert [len(Dataset.open(folder)) for folder in folders] == [10, 20, 40]
    assert all(uids(small) < uids(large) for small, large in itertools.pairwise(folders))
    for folder in folders:
        assert_taken_over(forty, folder)
    made = Dataset.open(folders[0])
    assert made.reference == "fake@data-1.1.0" and made.description["stage"] == "subset"
    assert made.description["config"] == {"episodes": 10, "percent": 25, "of": None, "seed": 3}
    assert made.description["parents"] == [forty.identity] and made.subset_seed == 3


def test_a_subset_of_a_subset_is_the_subset(forty: Dataset, tmp_path: Path) -> None:
    half = Dataset.open(subset(forty, episodes=20, seed=3, out=tmp_path / "half"))
    assert uids(subset(half, episodes=7, out=tmp_path / "a")) == uids(
        subset(forty, episodes=7, seed=3, out=tmp_path / "b")
    )
    assert uids(tmp_path / "a") != uids(subset(forty, episodes=7, out=tmp_path / "c"))


@pytest.mark.parametrize("are_named", [False, True])
def test_copies_of_a_recording_go_together(tmp_path: Path, are_named: bool) -> None:
    # Ten recordings, of each of which there are five copies, or six parts of logs with a name.
    facts: list[dict[str, int | str]] = [{"source_episode": uid % 10} if uid >= 10 else {} for uid in range(60)]
    facts = [{"source_episode": f"log_{uid % 10}"} for uid in range(60)] if are_named else facts
    copies = (replace(fake_episode(uid, 3), metadata=of) for uid, of in enumerate(facts))
    source, taken = write_fake(tmp_path / "copies", copies), set[int]()
    for episodes in (1, 14, 18, 36):
        found = uids(subset(source, episodes=episodes, out=tmp_path / f"{episodes}"))
        assert taken < found and len({uid % 10 for uid in found}) == -(-episodes // 6)
        taken = found
        assert {int(uid) for uid in source.uids[source.subset(episodes)]} == found
    again = uids(subset(Dataset.open(tmp_path / "36"), episodes=14, out=tmp_path / "again"))
    assert again == uids(tmp_path / "14")


def test_shares_are_rounded_half_up() -> None:
    assert [share(percent, 5) for percent in (9, 10, 29, 30, 150)] == [0, 1, 1, 2, 8]


def test_percent_is_of_a_given_number_and_nothing_is_repeated(forty: Dataset, tmp_path: Path) -> None:
    made = subset(forty, percent=150, of=20, out=tmp_path / "more")
    assert len(Dataset.open(made)) == 30
    with pytest.raises(BadInputError, match=r"150 % of 40 = 60: .*never repeated: collect or augment more"):
        subset(forty, percent=150, out=tmp_path / "too-many")
    with pytest.raises(BadInputError, match="the subset has 0 episodes"):
        subset(forty, episodes=0, out=tmp_path / "none")
    with pytest.raises(BadInputError, match="50 % of 0 = 0"):
        subset(forty, percent=50, of=0, out=tmp_path / "none")
    with pytest.raises(BadInputError, match="either a number of episodes or a percentage"):
        subset(forty, episodes=3, percent=3, out=tmp_path / "both")
    with pytest.raises(BadInputError, match=r"a percentage \(optionally with --of\)"):
        subset(forty, episodes=3, of=20, out=tmp_path / "of-what")
    with pytest.raises(BadInputError, match=r"name '', expected up to 200 of A-Z"):
        subset(forty, episodes=3, name="", out=tmp_path / "nameless")
    with pytest.raises(BadInputError, match="expected a folder outside of the dataset"):
        subset(forty, episodes=3, out=forty.root / "data/new")
    assert [path.name for path in tmp_path.iterdir()] == ["more"]


def test_a_filter_without_episodes_leaves_the_others(forty: Dataset, tmp_path: Path) -> None:
    folder = filter_episodes(forty, without=[39, 3, 39], out=tmp_path / "set")
    assert uids(folder) == set(range(40)) - {3, 39}
    assert_taken_over(forty, folder)
    assert Dataset.open(folder).description["config"] == {"without": [3, 39]}


def test_a_filter_without_an_unknown_episode_writes_nothing(forty: Dataset, tmp_path: Path) -> None:
    with pytest.raises(
        BadInputError, match=r"no episode 40, 99; its 40 uids lie between 0 and 39: 0, 1, .* and 32 more"
    ):
        filter_episodes(forty, without=[3, 99, 40], out=tmp_path / "set")
    with pytest.raises(BadInputError, match=r"none of its \d+ episodes would be left"):
        filter_episodes(forty, without=list(range(40)), out=tmp_path / "set")
    assert list(tmp_path.iterdir()) == []


def test_filters_meet_every_condition(forty: Dataset, tmp_path: Path) -> None:
    folder = filter_episodes(forty, success=True, min_return=2.5, max_return=9.5, max_length=4, out=tmp_path / "set")
    assert uids(folder) == {uid for uid in range(5, 20) if uid % 2 and 2 + uid % 5 <= 4}
    assert_taken_over(forty, folder)
    assert Dataset.open(folder).description["config"] == {
        "success": True,
        "min_return": 2.5,
        "max_return": 9.5,
        "max_length": 4,
    }
    failed = filter_episodes(forty, without=[5, 14], success=False, min_length=6, out=tmp_path / "failed")
    assert uids(failed) == {4, 24, 34}


def test_filters_that_cannot_work_are_refused(forty: Dataset, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="needs a condition"):
        filter_episodes(forty, out=tmp_path / "set")
    with pytest.raises(BadInputError, match="none of its 40 episodes would be left"):
        filter_episodes(forty, min_length=100, out=tmp_path / "set")
    with pytest.raises(BadInputError, match="expected numbers, got nan"):
        filter_episodes(forty, max_return=float("nan"), out=tmp_path / "set")
    unpaid = Episode(1, {name: values for name, values in fake_episode(1, 3).columns.items() if name != REWARD})
    bare = write_fake(tmp_path / "bare", [unpaid], columns=[column for column in COLUMNS if column.name != REWARD])
    with pytest.raises(BadInputError, match="have no 'return': run `astra-data label --task`"):
        filter_episodes(bare, min_return=0, out=tmp_path / "set")


def test_returns_that_are_not_told_are_sums_of_rewards(tmp_path: Path) -> None:
    episodes = [Episode(uid, fake_episode(uid, steps).columns) for uid, steps in ((3, 2), (1, 4), (2, 3))]
    for episode in episodes:
        episode.columns[REWARD][:] = 1.0
    bare = write_fake(tmp_path / "bare", episodes)
    assert uids(filter_episodes(bare, min_return=3, out=tmp_path / "set")) == {1, 2}
    assert uids(filter_episodes(bare, max_return=2, out=tmp_path / "low")) == {3}


def test_merge_puts_one_after_the_other(tmp_path: Path) -> None:
    parts = [write(tmp_path / f"{first}", range(first, first + 5)) for first in (10, 0, 5)]
    made = Dataset.open(merge(parts, out=tmp_path / "all"))
    assert made.verify() == [] and made.uids.tolist() == [*range(10, 15), *range(5), *range(5, 10)]
    assert made.description["parents"] == [part.identity for part in parts]
    for found, part in zip(made.episodes(), itertools.chain(*(part.episodes() for part in parts)), strict=True):
        assert found.metadata == part.metadata
        np.testing.assert_array_equal(found.columns[STATE], part.columns[STATE])


def test_repeated_uids_are_refused_or_replaced(tmp_path: Path) -> None:
    a, b = write(tmp_path / "a", range(5)), write(tmp_path / "b", range(4, 7))
    with pytest.raises(BadInputError, match=r"1 episodes have the uid .*\(4\).*--new-uids"):
        merge([a, b], out=tmp_path / "all")
    made = Dataset.open(merge([a, b, b], new_uids=True, out=tmp_path / "all"))
    assert made.uids[:5].tolist() == [0, 1, 2, 3, 4] and len(set(made.uids.tolist())) == 11
    assert made.metadata["merged_uid"][:6] == [None] * 5 + [4]
    again = Dataset.open(merge([a, b, b], new_uids=True, out=tmp_path / "again"))
    assert again.content_hash == made.content_hash


def test_copies_still_name_the_episodes_of_their_own_dataset(tmp_path: Path) -> None:
    parts = [write(tmp_path / f"{first}", range(first, 5)) for first in (1, 2)]
    assert [dict(zip(part.uids, part.metadata["source_episode"], strict=True))[3] for part in parts] == [2, 2]
    made = Dataset.open(merge(parts, new_uids=True, out=tmp_path / "all"))
    one, two, three, four, other_two, other_three, other_four = made.uids.tolist()
    assert [one, two, three, four] == [1, 2, 3, 4]
    assert len({one, two, three, four, other_two, other_three, other_four}) == 7
    assert made.metadata["source_episode"] == [None, None, two, None, None, other_two, None]
    assert made.metadata["merged_uid"] == [None, None, None, None, 2, 3, 4]
    more = Dataset.open(merge([made, made], new_uids=True, out=tmp_path / "more"))
    assert more.metadata["merged_uid"][7:] == made.uids.tolist()
    assert [more.metadata["source_episode"][row] for row in (9, 12)] == [more.uids[8], more.uids[11]]


@pytest.mark.parametrize("world", ["environment", "simulator"])
def test_datasets_of_different_worlds_are_not_merged(tmp_path: Path, world: str) -> None:
    parts = []
    for maze, uid in (("umaze", 1), ("long", 2)):
        described = {**DESCRIPTION, world: {"id": f"antmaze-{maze}", "timestep_s": 0.1}}
        parts.append(write_fake(tmp_path / maze, [fake_episode(uid, 3)], description=described))
    fault = rf"fake@data-1\.0\.0: {world}\.id: 'antmaze-umaze', then 'antmaze-long'"
    with pytest.raises(BadInputError, match=fault):
        merge(parts, out=tmp_path / "all")
    assert not (tmp_path / "all").exists()


def test_datasets_that_differ_are_told_apart(fake: Dataset, tmp_path: Path) -> None:
    columns = [*COLUMNS[:-1], Column("other", "int64")]
    with writer(tmp_path / "b", columns=columns, fps=10, task="walk") as open_writer:
        episode = fake_episode(1, 4)
        values = dict(episode.columns)
        values["other"] = values.pop("mode")
        open_writer.add(episode.__class__(1, values))
    with pytest.raises(BadInputError) as caught:
        merge([fake, Dataset.open(tmp_path / "b")], out=tmp_path / "all")
    for part in ("column mode: only in", "column other: only in", "fps: 20, then 10"):
        assert part in str(caught.value)
    assert "an import of its files" not in str(caught.value)
    with pytest.raises(BadInputError, match="two datasets or more"):
        merge([fake], out=tmp_path / "all")
    assert not (tmp_path / "all").exists()


def test_datasets_of_different_tasks_are_merged(tmp_path: Path) -> None:
    tasks = enumerate(("run", "walk", "run", "stand"))
    parts = [write_fake(tmp_path / str(uid), [fake_episode(uid, 3)], task=task) for uid, task in tasks]
    same = Dataset.open(merge([parts[0], parts[2]], out=tmp_path / "same"))
    assert (same.task, "task" in same.metadata) == ("run", False)
    two = Dataset.open(merge([parts[1], same], out=tmp_path / "two"))
    assert (two.task, two.metadata["task"]) == ("walk / run", ["walk", "run", "run"])
    more = Dataset.open(merge([two, parts[3]], out=tmp_path / "more"))
    assert (more.task, more.metadata["task"]) == ("walk / run / stand", ["walk", "run", "run", "stand"])
    part = Dataset.open(filter_episodes(more, without=[1], out=tmp_path / "part"))
    both = Dataset.open(merge([parts[1], part], out=tmp_path / "both"))
    assert (both.task, both.metadata["task"]) == ("walk / run / stand", ["walk", "run", "run", "stand"])
