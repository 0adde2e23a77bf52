from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from small_run import TASK, short_task

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import (
    ACTION,
    DONE,
    GOAL,
    NEXT_STATE,
    OUTCOME_COLUMNS,
    REWARD,
    STATE,
    SUCCESS,
    TERMINATED,
    TRUNCATED,
    Column,
    Episode,
)
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter
from astra_data.grounding.paired_episodes import PairedEpisodes
from astra_data.pipeline.stages.augment import AugmentConfig, Relocation, _moving, _shares, augment
from astra_data.pipeline.stages.collect import CollectConfig, collect
from astra_data.pipeline.stages.pair import pair
from astra_data.robots.ant.tasks import WALL_REACH_M
from astra_data.robots.registry import TASKS
from astra_data.worlds.geometry import rotation_matrix
from astra_data.worlds.plane.navigation import Navigation

CONFIG = AugmentConfig(episodes=24, held_out_share=0.25, min_steps=5)


@pytest.fixture(autouse=True)
def known_task(task: str) -> None:
    """Let the task of the small run be known."""


@pytest.fixture(scope="module")
def augmented(collected: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("augmented") / "turned"
    with short_task():
        return augment(None, CONFIG, dataset=collected, seed=1, out=out)


def facts(dataset: Dataset, index: int) -> dict[str, Any]:
    return {key: values[index] for key, values in dataset.metadata.items()}


def copies(source: Dataset, dataset: Dataset) -> Iterator[tuple[Episode, Episode]]:
    """Yield each copy with the stretch of its source that it was made of."""
    episodes = {episode.uid: episode for episode in source.episodes()}
    for copy in dataset.episodes():
        if copy.uid not in episodes:
            told = copy.metadata
            original = episodes[int(told["source_episode"])]
            steps = slice(int(told["augmentation_first_step"]), None)
            cut = {name: values[steps][: len(copy)] for name, values in original.columns.items()}
            yield copy, Episode(original.uid, cut, original.metadata)


def test_episodes_are_as_many_as_asked_and_none_is_lost(collected: Path, augmented: Path) -> None:
    source, dataset = Dataset.open(collected), Dataset.open(augmented)
    assert len(dataset) == CONFIG.episodes and dataset.verify() == []
    assert dataset.description["version"] == "1.1.0" and dataset.description["parents"] == [source.identity]
    assert dataset.description["seeds"] == source.description["seeds"] | {"augment": 1}
    assert dataset.description["copies"] == CONFIG.episodes - len(source) and dataset.features == source.features
    kept = {episode.uid: episode for episode in dataset.episodes()}
    for episode in source.episodes():
        for name, values in episode.columns.items():
            np.testing.assert_array_equal(values, kept[episode.uid].columns[name])
        told = dict(kept[episode.uid].metadata)
        told.pop("held_out")
        assert told == episode.metadata


def test_no_copy_of_a_held_out_episode_exists(collected: Path, augmented: Path) -> None:
    dataset = Dataset.open(augmented)
    told = [facts(dataset, index) for index in range(len(dataset))]
    held_out = {int(uid) for uid, fact in zip(dataset.uids, told, strict=True) if fact["held_out"]}
    sources = {fact["source_episode"] for fact in told} - {None}
    assert len(held_out) == 2 and held_out < set(Dataset.open(collected).uids.tolist()) and sources
    assert not sources & held_out


def test_copies_are_their_source_moved_as_they_say(collected: Path, augmented: Path) -> None:
    for copy, cut in copies(Dataset.open(collected), Dataset.open(augmented)):
        metadata = copy.metadata
        angle = float(metadata["augmentation_rotation_rad"])
        turn = np.eye(3)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        shift = np.array([metadata["augmentation_x_m"], metadata["augmentation_y_m"], 0.0])
        for name in (STATE, NEXT_STATE):
            before, after = cut.columns[name].astype(np.float64), copy.columns[name].astype(np.float64)
            np.testing.assert_allclose(after[:, :3], before[:, :3] @ turn.T + shift, atol=1e-5)
            np.testing.assert_allclose(after[:, 15:18], before[:, 15:18] @ turn.T, atol=1e-5)
            turned = turn @ rotation_matrix(before[:, 3:7])
            np.testing.assert_allclose(rotation_matrix(after[:, 3:7]), turned, atol=1e-5)
            np.testing.assert_array_equal(after[:, 18:21], before[:, 18:21])  # the rates about the body's axes stay
        np.testing.assert_allclose(copy.columns[ACTION], cut.columns[ACTION] @ turn[:2, :2].T, atol=1e-6)
        assert np.abs(copy.columns[ACTION]).max() <= 1 + 1e-6
        paths = (np.diff(episode.columns[STATE][:, :2], axis=0) for episode in (copy, cut))
        walked, before = (np.linalg.norm(path, axis=1).sum() for path in paths)
        assert walked == pytest.approx(before, rel=1e-4)


def test_the_target_does_what_copies_say(collected: Path, augmented: Path) -> None:
    """Put the ant where a copy was, give it the copy's command, and it lands where the copy did."""
    pairs = list(copies(Dataset.open(collected), Dataset.open(augmented)))
    moved, original = (
        [np.concatenate([pair[side].columns[name] for pair in pairs])[::6] for name in (STATE, ACTION, NEXT_STATE)]
        for side in (0, 1)
    )

    def errors(state: Any, action: Any, next_state: Any) -> Any:
        env = TASKS[TASK].target(len(state), seed=0, num_threads=1)
        env.reset_to(np.arange(len(state)), state.astype(np.float64))
        env.step(torch.from_numpy(action))
        assert not env.wall_contact.any()
        return np.abs(env.state.numpy() - next_state).max(axis=1)

    ours, theirs = errors(*moved), errors(*original)
    assert len(ours) > 40
    # States are stored as float32 and without the solver's warm start, in the originals as well.
    assert np.median(ours) < 10 * np.median(theirs) < 1e-4
    assert np.quantile(ours, 0.9) < 10 * np.quantile(theirs, 0.9) < 1e-3


def test_copies_and_what_they_copy_keep_out_of_the_walls_reach(collected: Path, augmented: Path) -> None:
    clearance = TASKS[TASK].maze.clearance
    for both in copies(Dataset.open(collected), Dataset.open(augmented)):
        for episode in both:
            paths = np.concatenate([episode.columns[STATE], episode.columns[NEXT_STATE]])
            assert (clearance(paths[:, :2]) > WALL_REACH_M).all()


def test_copies_are_judged_with_a_goal_of_their_own(collected: Path, augmented: Path) -> None:
    navigation = TASKS[TASK].objective
    assert isinstance(navigation, Navigation)
    goals = set()
    for copy, cut in copies(Dataset.open(collected), Dataset.open(augmented)):
        columns = copy.columns
        assert (columns[GOAL] == columns[GOAL][0]).all()
        goals.add(tuple(columns[GOAL][0].tolist()))
        assert np.abs(columns[GOAL][0] - navigation.maze.cell_center(*navigation.maze.goal)).max() < 0.7
        near = np.linalg.norm(columns[NEXT_STATE][:, :2] - columns[GOAL], axis=1) <= 0.45
        np.testing.assert_array_equal(columns[SUCCESS], near)
        toppled = cut.columns[TERMINATED] & ~cut.columns[SUCCESS]
        np.testing.assert_array_equal(columns[TERMINATED], near | toppled)
        np.testing.assert_array_equal(columns[TRUNCATED], columns[DONE] & ~columns[TERMINATED])
        assert columns[DONE].tolist() == [False] * (len(copy) - 1) + [True]
        start, end, goal = (torch.from_numpy(columns[name][:, :2].copy()) for name in (STATE, NEXT_STATE, GOAL))
        meters = (navigation.goal_distance(start, goal) - navigation.goal_distance(end, goal)).numpy()
        np.testing.assert_allclose(columns[REWARD], meters + 10.0 * near - 10.0 * toppled, atol=1e-4)
        assert copy.metadata["return"] == pytest.approx(columns[REWARD].sum(), abs=1e-4)
        assert copy.metadata["success"] == near.any()
        assert copy.metadata["failed"] == (toppled.any() and not near.any())
    assert len(goals) == CONFIG.episodes - len(Dataset.open(collected))  # type: ignore[operator]


def test_the_seed_decides_every_byte(collected: Path, augmented: Path, tmp_path: Path) -> None:
    def contents(root: Path) -> list[bytes]:
        return [path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()]

    again = augment(TASK, CONFIG, dataset=collected, seed=1, out=tmp_path / "again")
    other = augment(TASK, CONFIG, dataset=collected, seed=2, out=tmp_path / "other")
    assert contents(again) == contents(augmented)
    uids = [set(Dataset.open(root).uids.tolist()) for root in (collected, augmented, other)]
    assert uids[1] & uids[2] == uids[0]


class Ten:
    """Ten episodes, by their numbers; of number 3 no stretch can be copied."""

    reference, margin_m, recordings = "ten", 0.0, np.arange(10)

    def __len__(self) -> int:
        return 10

    def episodes(self, names: object) -> Iterator[int]:
        yield from range(10)

    def stretches(self, episode: int) -> list[tuple[int, int]]:
        return [] if episode == 3 else [(0, 9)]


def shares(seed: int = 0, **settings: Any) -> tuple[Any, Any]:
    """Return who of the ten is held out, and the copies of each."""
    ten: Any = Ten()
    held_out, copies = _shares(ten, ten, AugmentConfig(**settings), seed)
    assert not copies[held_out].any() and copies[3] == 0
    return held_out, copies


@pytest.mark.parametrize(("share", "count"), [(0.0, 0), (0.01, 1), (0.1, 1), (0.34, 3)])
def test_a_share_is_held_out_at_least_one_unless_it_is_none(share: float, count: int) -> None:
    held_out, copies = shares(held_out_share=share)
    assert held_out.sum() == count
    usable = ~held_out & (np.arange(10) != 3)
    assert (copies[usable] == 3).all()
    assert (len({tuple(shares(seed, held_out_share=share)[0]) for seed in range(9)}) > 1) == (share > 0)


def test_parts_of_a_recording_are_held_out_together() -> None:
    ten: Any = Ten()
    ten.recordings = np.array([0, 1, 2, 3, 4, 4, 2, 1, 0, 4])
    for seed in range(5):
        held_out, copies = _shares(ten, ten, AugmentConfig(episodes=11, held_out_share=0.4), seed)
        held = {*ten.recordings[held_out].tolist()}
        assert len(held) == 2 and (held_out == np.isin(ten.recordings, [*held])).all()
        assert copies.sum() == 1 and not copies[held_out].any()


def test_copies_make_up_the_episodes_that_are_asked_for_and_the_odd_ones_are_of_any() -> None:
    copies = shares(episodes=23, held_out_share=0.2)[1]
    assert copies.sum() == 13 and np.ptp(copies[copies > 0]) <= 1
    assert shares(episodes=10, held_out_share=0.2)[1].sum() == 0
    more = [shares(seed, episodes=11, held_out_share=0.2)[1].argmax() for seed in range(20)]
    assert len(set(more)) > 5


def test_copies_without_a_place_are_counted_and_none_at_all_is_an_error(
    collected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copied, asked = Relocation.copied, iter(range(1000))
    monkeypatch.setattr(Relocation, "copied", lambda *given: copied(*given) if next(asked) % 3 == 0 else None)
    config = AugmentConfig(min_steps=5)
    told = Dataset.open(augment(None, config, dataset=collected, out=tmp_path / "some")).description
    assert told["copies_without_place"] == 2 * told["copies"] > 0
    assert told["copies"] + told["episodes_not_copied"] == 7  # all of the eight but the one held out
    monkeypatch.setattr(Relocation, "copied", lambda *given: None)
    with pytest.raises(BadInputError, match=r"found no place for any of \d+ copies: lower --margin-m"):
        augment(None, config, dataset=collected, out=tmp_path / "none")
    assert [path.name for path in tmp_path.iterdir()] == ["some"]


def test_whole_numbers_outcomes_and_goals_are_not_moved() -> None:
    columns = [Column(STATE, size=2), Column("mode", "int64"), Column(GOAL, size=2), *OUTCOME_COLUMNS]
    source: Any = SimpleNamespace(schema=[*columns, Column("force")])
    assert [column.name for column in _moving(source)] == [STATE, "force"]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"margin_m": 9.0}, r"none of 7 training episodes keeps 9 m from the walls for 20 steps"),
        ({"margin_m": 0.0, "min_steps": 99}, r"none of 7 training episodes keeps 0 m from .* for 99 steps"),
        ({"episodes": 7}, r"--episodes 7: expected at least 8, the number of originals"),
    ],
)
def test_what_cannot_be_done_is_told(collected: Path, tmp_path: Path, changes: dict[str, Any], told: str) -> None:
    with pytest.raises(BadInputError, match=told):
        augment(None, AugmentConfig(**changes), dataset=collected, out=tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_datasets_that_do_not_fit_are_refused(collected: Path, augmented: Path, paired: Path, tmp_path: Path) -> None:
    source = Dataset.open(collected)
    silent_columns = [replace(c, astra=None) if c.name == STATE else c for c in source.schema]
    mute = tmp_path / "mute"
    description = {"name": "mute", "stage": "import"}
    with DatasetWriter(mute, silent_columns, fps=20, task="run", description=description) as writer:
        writer.add(next(source.episodes()))
    for dataset, task, told in (
        (paired, None, "it has been paired; augment its parent"),
        (augmented, None, "it has been augmented; augment its parent"),
        (collected, "antmaze-long", "was collected for antmaze-short, not for antmaze-long"),
        (mute, None, "give --task"),
        (mute, TASK, "observation.state: it has no roles"),
        (mute, "antmaze-umase", "did you mean 'antmaze-umaze'"),
        (mute, "nao-kick", r"observation.state has 29 values, expected those of nao-kick: \d+"),
    ):
        with pytest.raises(BadInputError, match=told):
            augment(task, CONFIG, dataset=dataset, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_code_that_a_dataset_names_is_not_run(collected: Path, tmp_path: Path) -> None:
    """Nobody asked for it: datasets come from strangers."""
    code = tmp_path / "task.py"
    code.write_text(f"from pathlib import Path\nPath({str(tmp_path / 'ran')!r}).touch()\n")
    source = Dataset.open(collected)
    foreign = tmp_path / "foreign"
    description = {"name": "foreign", "stage": "import", "environment": {"id": f"{code}:TASK"}}
    with DatasetWriter(foreign, source.schema, fps=20, task="run", description=description) as writer:
        writer.add(next(source.episodes()))
    with pytest.raises(BadInputError, match=r"task\.py:TASK, whose code would be run: read it"):
        augment(None, CONFIG, dataset=foreign, out=tmp_path / "out")
    assert not (tmp_path / "ran").exists()


def test_commands_at_their_limits_are_moved(collected: Path) -> None:
    episode, limits = next(Dataset.open(collected).episodes()), np.array(list(TASKS[TASK].limits.values())).T
    relocation = Relocation(TASKS[TASK], "none", False, 0.0, 5)
    for share, is_moved in ((1.0, True), (1.01, False)):
        for end in limits:
            episode.columns[ACTION][:] = share * end
            assert any(relocation.placements(episode, np.random.default_rng(0))) == is_moved


def test_balls_are_moved_with_their_robots(tmp_path: Path) -> None:
    kicking, task = tmp_path / "kicking", TASKS["nao-kick"]
    collect("nao-kick", CollectConfig(episodes=3, max_steps=20), out=kicking)
    config = AugmentConfig(episodes=9, held_out_share=0.3, min_steps=5)
    folder = augment(None, config, dataset=kicking, out=tmp_path / "out")
    made = list(copies(Dataset.open(kicking), Dataset.open(folder)))
    assert len(made) == 6
    for copy, source in made:
        states = (episode.columns[STATE][: len(copy)] for episode in (copy, source))
        paths = [np.asarray(task.abstraction(state), np.float64) for state in states]
        apart, before = (path[:, 4:6] - path[:, :2] for path in paths)
        np.testing.assert_allclose(np.linalg.norm(apart, axis=1), np.linalg.norm(before, axis=1), atol=1e-5)
        assert np.abs(apart - before).max() > 0.01
    assert len(PairedEpisodes.load(pair("nao-kick", dataset=folder, out=tmp_path / "paired"))) == 9


def test_grounding_holds_out_what_was_not_copied(augmented: Path, tmp_path: Path) -> None:
    folder = pair(TASK, dataset=augmented, out=tmp_path / "paired")
    dataset = Dataset.open(folder)
    first: dict[bool, set[float]] = {False: set(), True: set()}
    for episode, held in zip(dataset.episodes([STATE]), dataset.metadata["held_out"], strict=True):
        first[bool(held)].add(float(episode.columns[STATE][0, 0]))
    for split, held in zip(PairedEpisodes.load(folder).split(0.1, seed=0), (False, True), strict=True):
        assert set(split.target_state[:, 0, 0].tolist()) == first[held]
