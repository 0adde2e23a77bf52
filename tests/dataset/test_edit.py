import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_dataset import COLUMNS, DESCRIPTION, LENGTHS, assert_same, fake_episode, write_fake, write_transitions, writer

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import (
    ACTION,
    DONE,
    NEXT_STATE,
    REWARD,
    STATE,
    SUCCESS,
    TERMINATED,
    TRUNCATED,
    Column,
    Episode,
)
from astra_data.dataset.edit import filter_episodes, merge, resample, share, subset, trim
from astra_data.dataset.reader import Dataset

EPOCH_NS = 1_700_000_000_123_456_789
TURNS = {"unit": ["m", "rad", "1", "1", "1", "1"], "role": ["invariant", "heading", *["quaternion"] * 4]}
NAMED = ("x", "base.yaw", "quat_w", "quat_x", "quat_y", "quat_z")


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
    assert len(Dataset.open(subset(forty, percent=150, of=20, out=tmp_path / "more"))) == 30
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


def test_a_filter_without_episodes_leaves_the_others(
    forty: Dataset, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = filter_episodes(forty, without=[39, 3, 39], out=tmp_path / "set")
    assert uids(folder) == set(range(40)) - {3, 39}
    assert_taken_over(forty, folder)
    assert Dataset.open(folder).description["config"] == {"without": [3, 39]} and not caplog.messages


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
    told = {1: {"return": 4.0}}
    lengths = {3: 2, 1: 4, 2: 3}
    episodes = [Episode(uid, fake_episode(uid, n).columns, told.get(uid, {})) for uid, n in lengths.items()]
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


def made(path: Path) -> list[Episode]:
    return list(Dataset.open(path).episodes())


def test_time_goes_from_both_ends_and_what_lost_its_end_is_truncated(
    fake: Dataset, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    found = made(trim(fake, start_s=0.1, end_s=0.2, out=tmp_path / "out"))  # 2 and 4 of 20 steps a second
    before = {episode.uid: episode for episode in fake.episodes()}
    assert [len(one) for one in found] == [length - 6 for length in LENGTHS if length > 6]
    gone = [f"{uid}" for uid, length in zip(fake.uids, LENGTHS, strict=True) if length <= 6]
    assert caplog.messages == [f"nothing remains of {len(gone)} of {len(LENGTHS)} episodes: {', '.join(gone)}"]
    for one in found:
        whole = before[one.uid].columns
        np.testing.assert_array_equal(one.columns[STATE], whole[STATE][2:-4])
        assert one.columns[TRUNCATED].tolist() == one.columns[DONE].tolist() == [*[False] * (len(one) - 1), True]
        assert not one.columns[TERMINATED].any() and one.metadata["success"] is False
        assert one.metadata["return"] == pytest.approx(whole[REWARD][2:-4].sum(), rel=1e-5)
    assert len(made(trim(fake, end_s=0.3, out=tmp_path / "end_alone"))) == len(found)


def test_an_episode_that_lost_its_failure_has_not_failed(tmp_path: Path) -> None:
    episode = fake_episode(1, 9)
    columns = {**episode.columns, SUCCESS: np.zeros(9, bool)}
    with writer(tmp_path / "failed") as opened:
        opened.add(replace(episode, columns=columns, metadata={"failed": True, "success": False}))
    failed = Dataset.open(tmp_path / "failed")
    for start_s, end_s, expected in (0.1, 0.0, True), (0.0, 0.1, False):
        [one] = made(trim(failed, start_s=start_s, end_s=end_s, out=tmp_path / str(expected)))
        assert one.metadata == {"failed": expected, "success": False}


def test_an_episode_that_loses_nothing_stays_as_it_is(fake: Dataset, tmp_path: Path) -> None:
    (whole,) = [episode for episode in fake.episodes() if len(episode) == 30]
    (found,) = [one for one in made(trim(fake, without="mode == 0.5", out=tmp_path / "out")) if len(one) == 30]
    assert found.uid == whole.uid and found.metadata == whole.metadata and not found.columns[TRUNCATED][:-1].any()


def test_steps_of_a_condition_go_and_what_is_left_are_episodes(tmp_path: Path) -> None:
    columns = [Column(STATE, size=2, names=("x", "v")), Column("charging", "bool"), Column(REWARD)]
    with writer(tmp_path / "logs", columns=columns) as open_writer:
        v = np.array([1, 0, 0, 2, 3, 0, 1], np.float32)
        values = {STATE: np.stack([np.arange(7, dtype=np.float32), v], 1), REWARD: v, "charging": v == 3}
        open_writer.add(Episode(5, values, {"return": 7.0}))
    logs = Dataset.open(tmp_path / "logs")
    found = made(trim(logs, without="v < 0.5", out=tmp_path / "moving"))
    assert [one.columns[STATE][:, 0].tolist() for one in found] == [[0], [3, 4], [6]]
    assert found[0].uid == 5 and len({one.uid for one in found}) == 3
    assert [one.metadata.get("source_episode") for one in found] == [None, 5, 5]
    assert [one.metadata["return"] for one in found] == [1.0, 5.0, 1.0]
    again = made(trim(logs, without="v < 0.5", out=tmp_path / "again"))
    assert [one.uid for one in again] == [one.uid for one in found]
    for text, left in (("observation.state.v>=2", [3, 2]), ("charging == true", [4, 2])):
        assert [len(one) for one in made(trim(logs, without=text, out=tmp_path / text[:4]))] == left


def test_still_ends_go_and_pauses_stay(tmp_path: Path) -> None:
    x = np.array([0, 0, 0, 1, 1, 2, 2, 2], np.float32)
    parts = (x[:-1], x[1:]), (np.zeros(3, np.float32),) * 2
    episodes = (Episode(uid, {STATE: now, NEXT_STATE: later}) for uid, (now, later) in enumerate(parts))
    logs = write_fake(tmp_path / "logs", episodes, columns=[Column(STATE), Column(NEXT_STATE)])
    blind = write_fake(tmp_path / "blind", [Episode(0, {ACTION: x})], columns=[Column(ACTION)])
    with pytest.raises(BadInputError, match=r"has no column observation\.state; it has action"):
        trim(blind, still=True, out=tmp_path / "none")
    (found,) = made(trim(logs, still=True, out=tmp_path / "out"))
    assert found.columns[STATE].tolist() == [0, 1, 1] and found.columns[NEXT_STATE].tolist() == [1, 1, 2]
    short = write_fake(  # without next states, the last step goes on as the one before
        tmp_path / "short",
        [Episode(uid, {STATE: now[:6]}) for uid, now in enumerate((x, x[2:]))],
        columns=[Column(STATE)],
    )
    assert [one.columns[STATE].tolist() for one in made(trim(short, still=True, out=tmp_path / "moved"))] == [
        [0, 1, 1, 2],
        [0, 1, 1],
    ]


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({}, "expected a time of 0 s or more at the start or the end, --still or --without a condition, got none"),
        ({"start_s": float("inf")}, "got --start inf and --end 0"),
        ({"end_s": float("nan")}, "got --start 0 and --end nan"),
        ({"start_s": 0.02, "end_s": 0.02}, "expected a step or more, 0.05 s"),
        ({"start_s": 99.0}, "none of its 5 episodes would be left"),
        ({"without": "mode"}, "expected a condition such as 'v < 0.05'"),
        ({"without": "x < near"}, "expected a condition such as 'v < 0.05'"),
        ({"without": "mod < 3"}, "no value 'mod': did you mean 'mode'"),
        ({"without": "next.terminated == 2"}, "next.terminated is true or false: expected one of them, got 2"),
    ],
)
def test_what_cannot_be_trimmed_is_told_and_nothing_written(
    fake: Dataset, tmp_path: Path, asked: dict[str, float], message: str
) -> None:
    with pytest.raises(BadInputError, match=message):
        trim(fake, out=tmp_path / "out", **asked)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def turning(folder: Path, fps: int, steps: int, names: tuple[str, ...] = ()) -> Dataset:
    """A robot that moves by 2 m/s and turns by 3 rad/s, recorded `fps` times a second, commands by their number.

    What turns is known by roles, or by `names` alone.
    """
    known: dict[str, Any] = {"names": names} if names else {"astra": TURNS}
    time_s = np.arange(steps + 1) / fps
    yaw = 3 * time_s
    quaternion = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], 1)
    quaternion[::2] *= -1  # the same rotation
    state = np.concatenate([2 * time_s[:, None], ((yaw + np.pi) % (2 * np.pi) - np.pi)[:, None], quaternion], 1)
    last = np.arange(steps) == steps - 1
    columns = [Column(STATE, size=6, **known), Column(NEXT_STATE, size=6, **known), Column(ACTION)]
    columns += [Column(REWARD), Column(TERMINATED, "bool"), Column(SUCCESS, "bool"), Column("abstract.state")]
    columns += [
        Column("time"),
        Column("time_ns", "int64"),
        Column("observation.off", size=4, astra={"role": TURNS["role"][2:]}),
    ]
    values = {STATE: state[:-1], NEXT_STATE: state[1:], ACTION: np.arange(steps), REWARD: np.ones(steps)}
    values |= {"abstract.state": np.zeros(steps), "time": 5 + time_s[:-1], "observation.off": np.zeros((steps, 4))}
    others = {
        TERMINATED: last,
        SUCCESS: last & False,
        "time_ns": EPOCH_NS + np.rint(1e9 * time_s[:-1]).astype(np.int64),
    }
    floats = {name: value.astype(np.float32) for name, value in values.items()}
    episode = Episode(3, floats | others, {"return": float(steps), "success": False})
    return write_fake(folder, [episode], columns=columns, fps=fps)


@pytest.mark.parametrize("names", [(), NAMED, (*NAMED[:2], "orientation_w", "a", "b", "orientation_z")])
@pytest.mark.parametrize(("recorded", "fps", "steps"), [(62, 10, 12), (62, 25, 31), (62, 100, 124), (61, 100, 122)])
def test_states_at_another_rate_are_where_the_robot_was(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, recorded: int, fps: int, steps: int, names: tuple[str, ...]
) -> None:
    root = resample(turning(tmp_path / "logs", 50, recorded, names), fps, out=tmp_path / "out")
    found, (episode,) = Dataset.open(root), made(root)
    assert found.info["fps"] == fps and len(episode) == steps
    time_s = np.arange(len(episode)) / fps
    for name, at in ((STATE, time_s), (NEXT_STATE, time_s + 1 / fps)):
        state = episode.columns[name]
        np.testing.assert_allclose(state[:, 0], 2 * at, atol=1e-5)
        apart = (state[:, 1] - 3 * at + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(apart, 0, atol=1e-5)
        assert np.abs(state[:, 1]).max() <= np.pi + 1e-5
        w, z = state[:, 2], state[:, 5]
        np.testing.assert_allclose((2 * np.arctan2(z, w) - 3 * at + np.pi) % (2 * np.pi) - np.pi, 0, atol=1e-3)
        np.testing.assert_allclose(w**2 + z**2, 1, atol=1e-5)
    np.testing.assert_array_equal(episode.columns[ACTION], np.floor(time_s * 50 + 1e-6))
    np.testing.assert_allclose(episode.columns["time"], 5 + time_s, atol=1e-5)
    np.testing.assert_array_equal(episode.columns["time_ns"] - EPOCH_NS, np.rint(1e9 * time_s))
    assert not episode.columns["observation.off"].any()
    assert episode.columns[REWARD].sum() == recorded == episode.metadata["return"]
    assert episode.columns[TERMINATED].tolist() == [*[False] * (len(episode) - 1), True]
    assert "abstract.state" not in found.features and caplog.messages[-1].endswith("abstract.state; pair it again")


def test_next_states_are_the_states_after_them_whatever_is_known_of_their_angles(tmp_path: Path) -> None:
    source = write_transitions(tmp_path / "set")  # of which the states alone have roles
    for one in made(resample(source, 30, out=tmp_path / "fast")):
        np.testing.assert_array_equal(one.columns[NEXT_STATE][:-1], one.columns[STATE][1:])


def test_rewards_and_endings_are_those_of_all_steps_within(tmp_path: Path) -> None:
    (episode,) = made(resample(turning(tmp_path / "logs", 50, 13), 10, out=tmp_path / "out"))
    assert episode.columns[REWARD].tolist() == [5, 8]  # and of the three after the last whole one
    assert episode.columns[ACTION].tolist() == [0, 5] and episode.uid == 3


def test_without_next_states_the_last_state_has_no_step_after_it(tmp_path: Path) -> None:
    after = ("next.observation.load", "next.mode")  # what is next is after the longer step
    time = np.arange(6, dtype=np.float32)
    recorded = Episode(0, {STATE: time} | dict.fromkeys(after, time + 1))
    logs = write_fake(tmp_path / "logs", [recorded], columns=[Column(STATE), *map(Column, after)], fps=10)
    (episode,) = made(resample(logs, 5, out=tmp_path / "out"))
    assert episode.columns[STATE].tolist() == [0, 2, 4]
    assert [episode.columns[name].tolist() for name in after] == [[2, 4, 6]] * 2


def test_angles_that_are_counted_go_on(tmp_path: Path) -> None:
    columns = [Column(name, astra={"unit": ["rad"]}) for name in (STATE, NEXT_STATE)]
    parts = enumerate(np.split(4 * np.arange(9, dtype=np.float32), [2]))
    turns = (Episode(uid, {STATE: angles, NEXT_STATE: angles + 4}) for uid, angles in parts)
    logs = write_fake(tmp_path / "logs", turns, columns=columns, fps=10)
    for episode in made(resample(logs, 20, out=tmp_path / "out")):
        first = 8 * episode.uid
        assert episode.columns[STATE].tolist() == [*range(first, first + 2 * len(episode), 2)]


@pytest.mark.parametrize("fps", [20, 0, -5, 2001])
def test_another_rate_is_one(fake: Dataset, fps: int, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=f"expected another rate than 20 per second, from 1 to 2000, got {fps}"):
        resample(fake, fps, out=tmp_path / "out")


def test_a_name_that_several_columns_have_means_the_first(fake: Dataset, tmp_path: Path) -> None:
    found = made(trim(fake, without="x > 0", out=tmp_path / "out"))
    assert all((one.columns[STATE][:, 0] <= 0).all() for one in found)
    assert sum(map(len, found)) == sum(int((one.columns[STATE][:, 0] <= 0).sum()) for one in fake.episodes())
    found = made(trim(fake, without="action.x > 0", out=tmp_path / "action"))
    assert all((one.columns[ACTION][:, 0] <= 0).all() for one in found)
