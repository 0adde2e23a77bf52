import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from damaged import reseal

from astra_data.core.errors import BadInputError
from astra_data.dataset import columns as keys
from astra_data.dataset.edit import filter_episodes
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter
from astra_data.grounding import paired_episodes
from astra_data.grounding.paired_episodes import PairedEpisodes, draw_steps
from astra_data.robots.registry import TASKS
from astra_data.worlds.commands import Commands

LENGTHS = (7, 1, 12, 30, 5)
ABSTRACT = (keys.ABSTRACT_STATE, keys.ABSTRACT_NEXT_STATE, keys.ABSTRACT_SIMULATED_NEXT_STATE)


def label(episode: int, step: int) -> float:
    """Return the first entry of everything that happened in a step."""
    return 100.0 * (episode + 1) + step


SIZES = {keys.STATE: 3, keys.GOAL: 2, keys.ACTION: 2} | dict.fromkeys(ABSTRACT, 4)


def write(
    folder: Path,
    sizes: dict[str, int],
    held_out: tuple[int, ...] | None = None,
    *,
    made_up: bool = False,
    sources: dict[int, int] | None = None,
    commands: dict[str, tuple[float, float]] | None = None,
    lacks: str = "",
) -> Path:
    given = (*keys.OUTCOME_COLUMNS[:-1], keys.Column(keys.SUCCESS))  # a number, as of logs
    outcomes = [column for column in given if column.name != lacks]
    columns = [*(keys.Column(name, size=size) for name, size in sizes.items()), *outcomes]
    description = {"name": "toy", "stage": "pair", "config": {}, "seeds": {"collect": 0}}
    simulator = {"id": "toy"} | ({"commands": commands} if commands else {})
    description |= {"environment": {"id": "toy"}, "simulator": simulator, "parents": []}
    with DatasetWriter(folder, columns, fps=20, task="toy", description=description) as writer:
        for episode, length in enumerate(LENGTHS):
            steps = np.array([label(episode, step) for step in range(length)], dtype=np.float32)
            last = np.arange(length) == length - 1
            values = {name: steps[:, None] + np.arange(size, dtype=np.float32) for name, size in sizes.items()}
            # The third episode succeeds, the fourth topples, the others run out of time.
            ended = last & (episode in (2, 3))
            values |= {keys.REWARD: -steps, keys.TERMINATED: ended, keys.TRUNCATED: last & ~ended, keys.DONE: last}
            if keys.NEXT_STATE in sizes:
                moved = (~ended if made_up else np.ones(length)).astype(np.float32)
                values[keys.NEXT_STATE] = values[keys.STATE] + moved[:, None]
            metadata: dict[str, int] = {} if held_out is None else {"held_out": episode in held_out}
            metadata |= {"source_episode": sources[episode]} if sources and episode in sources else {}
            values |= {keys.SUCCESS: (last & (episode == 2)).astype(np.float32)}
            values.pop(lacks, None)
            writer.add(keys.Episode(episode, values, metadata))
    return folder


def test_a_next_state_that_was_made_up_is_no_step(tmp_path: Path) -> None:
    sizes = SIZES | {keys.NEXT_STATE: 3}
    episodes = PairedEpisodes.load(write(tmp_path / "pairs", sizes))
    merged = PairedEpisodes.load(write(tmp_path / "made_up", sizes, held_out=(1, 3), made_up=True))
    # The third and the fourth episode, which are terminated, lose their last step; the one of a step is kept.
    assert episodes.lengths.tolist() == [7, 1, 12, 30, 5] and merged.lengths.tolist() == [7, 1, 11, 29, 5]
    assert merged.terminated.nonzero().tolist() == [[2, 10], [3, 28]]
    assert merged.windows.reward[2, :11].tolist() == [*(-label(2, step) for step in range(10)), -621.0]
    assert merged.windows.reward[3, 28] == -label(3, 28) - label(3, 29)
    assert merged.windows.next_state[3, 28, 0] == label(3, 28)
    assert merged.windows.failed.nonzero().tolist() == [[3, 28]]  # the third still succeeds
    assert merged.held_out is not None and merged.held_out.tolist() == [False, True, False, True, False]


def test_where_no_step_is_one_of_the_robot_there_is_nothing_to_load(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The third and the fourth episode end in the only step that they have."""
    monkeypatch.setitem(globals(), "LENGTHS", (1, 1, 1, 1))
    whole = write(tmp_path / "pairs", SIZES | {keys.NEXT_STATE: 3}, made_up=True)
    left = PairedEpisodes.load(whole)
    assert left.lengths.tolist() == [1, 1] and left.windows.reward.tolist() == [[-label(0, 0)], [-label(1, 0)]]
    ended = filter_episodes(Dataset.open(whole), without=[0, 1], out=tmp_path / "ended")
    with pytest.raises(BadInputError, match="no step is left: each episode has one, whose"):
        PairedEpisodes.load(ended)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("pairs") / "dataset", SIZES)


@pytest.fixture
def episodes(root: Path) -> PairedEpisodes:
    return PairedEpisodes.load(root)


def test_episodes_are_padded_at_the_end(episodes: PairedEpisodes) -> None:
    windows = episodes.windows
    assert len(episodes) == 5 and episodes.lengths.tolist() == list(LENGTHS)
    for episode, length in enumerate(LENGTHS):
        expected = torch.tensor([label(episode, step) for step in range(length)])
        for values in (episodes.target_state, windows.state, windows.next_state, windows.simulated_next):
            assert torch.equal(values[episode, :length, 0], expected) and (values[episode, length:] == 0).all()
        assert windows.mask[episode].tolist() == [1.0] * length + [0.0] * (30 - length)
    assert len(episodes.steps(windows.goal)) == sum(LENGTHS)


def test_rewards_are_as_recorded_and_what_ends_an_episode_is_marked(episodes: PairedEpisodes) -> None:
    windows = episodes.windows
    for episode, length in enumerate(LENGTHS):
        expected = -torch.tensor([label(episode, step) for step in range(length)])
        assert torch.equal(windows.reward[episode, :length], expected)
        goes_on = [1.0] * (length - 1) + [0.0 if episode in (2, 3) else 1.0]
        assert windows.goes_on[episode].tolist() == goes_on + [0.0] * (30 - length)
    assert windows.failed.nonzero().tolist() == [[3, 29]]


def test_only_the_last_second_before_a_bad_end_fails_soon(episodes: PairedEpisodes) -> None:
    assert episodes.windows.fails_soon.nonzero().tolist() == [[3, step] for step in range(10, 30)]


def test_an_episode_far_longer_than_most_comes_in_pieces_of_one_recording(
    root: Path, episodes: PairedEpisodes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paired_episodes, "_LONG_STEPS", 8)
    monkeypatch.setattr(paired_episodes, "_LONG_RATIO", 1)  # times the mean, 11
    cut = PairedEpisodes.load(root)
    assert cut.lengths.tolist() == [7, 1, 1, 11, 8, 11, 11, 5]
    assert cut.uids.tolist() == cut.recordings.tolist() == [0, 1, 2, 2, 3, 3, 3, 4]
    assert torch.equal(cut.steps(cut.target_state), episodes.steps(episodes.target_state))
    assert cut.windows.failed.nonzero().tolist() == [[6, 10]] and cut.windows.fails_soon.sum() == 11
    assert PairedEpisodes.load(root, whole=True).lengths.tolist() == list(LENGTHS)
    monkeypatch.setattr(paired_episodes, "_LONG_STEPS", 30)
    assert PairedEpisodes.load(root).lengths.tolist() == list(LENGTHS)


def test_a_split_is_by_episodes_and_by_the_seed(episodes: PairedEpisodes) -> None:
    training, held_out = episodes.split(0.4, seed=3)
    names = [set(part.target_state[:, 0, 0].tolist()) for part in (training, held_out)]
    assert [len(part) for part in names] == [3, 2]
    assert names[0] | names[1] == {label(episode, 0) for episode in range(5)}
    assert torch.equal(training.windows.state[:, 0, 0], training.target_state[:, 0, 0])
    again, _ = episodes.split(0.4, seed=3)
    assert torch.equal(again.target_state, training.target_state)
    assert len({tuple(episodes.split(0.4, seed)[1].target_state[:, 0, 0].tolist()) for seed in range(9)}) > 1
    assert len(episodes.split(0.0001, seed=0)[1]) == 1


def test_a_split_is_as_the_dataset_marks_it(tmp_path: Path) -> None:
    marked = PairedEpisodes.load(write(tmp_path / "marked", SIZES, held_out=(1, 3)))
    assert marked.held_out is not None and marked.held_out.tolist() == [False, True, False, True, False]
    training, held_out = marked.split(0.9, seed=0)
    assert training.target_state[:, 0, 0].tolist() == [label(episode, 0) for episode in (0, 2, 4)]
    assert held_out.target_state[:, 0, 0].tolist() == [label(episode, 0) for episode in (1, 3)]
    assert training.held_out is not None and not training.held_out.any()
    with pytest.raises(BadInputError, match="expected episodes to train on, got 2 that augmentation held out"):
        marked.select(torch.tensor([1, 3])).split(0.5, seed=0)
    assert PairedEpisodes.load(write(tmp_path / "none", SIZES, held_out=())).held_out is None


def test_copies_are_held_out_with_their_recording(tmp_path: Path) -> None:
    folder = write(tmp_path / "copies", SIZES, held_out=(), sources={1: 3, 2: 9, 4: 9})
    episodes = PairedEpisodes.load(folder)
    assert episodes.recordings.tolist() == [0, 1, 2, 1, 2]
    chosen = episodes.select(torch.tensor([3, 0]))
    assert (chosen.uids.tolist(), chosen.recordings.tolist()) == ([3, 0], [1, 0])
    recorded = [{0}, {1, 3}, {2, 4}]
    splits = [episodes.split(0.34, seed) for seed in range(9)]
    numbers = [[{int(start) // 100 - 1 for start in part.target_state[:, 0, 0]} for part in split] for split in splits]
    assert all(held_out in recorded and training == {0, 1, 2, 3, 4} - held_out for training, held_out in numbers)
    assert {min(held_out) for _, held_out in numbers} == {0, 1, 2}


@pytest.mark.parametrize("length", [1, 10, 100])
def test_windows_hold_every_step_equally_often(episodes: PairedEpisodes, length: int) -> None:
    torch.manual_seed(0)
    count = 20_000
    windows, target_state = episodes.draw_windows(count, length)
    length = min(length, 30)
    assert windows.mask.shape == (count, length) and torch.equal(target_state[..., 0], windows.state[..., 0])
    labels = windows.state[..., 0]
    within = labels > 0
    assert within[windows.mask.bool()].all()
    number, step = (labels / 100).floor(), labels % 100  # one episode each, and steps in order
    assert ((number == number[:, :1]) | ~within).all()
    assert ((step - step[:, :1] == torch.arange(length)) | ~within).all()
    seen, times = labels[windows.mask.bool()].unique(return_counts=True)
    expected = {label(episode, step) for episode, steps in enumerate(LENGTHS) for step in range(steps)}
    assert set(seen.tolist()) == expected
    mean = count * length / sum(steps + length - 1 for steps in LENGTHS)
    assert (times - mean).abs().max() < 5 * mean**0.5


@pytest.mark.parametrize(
    ("kept", "dropped"), [("invariant", (1, 2)), ("position", ()), (None, ())], ids=["no", "yes", "untold"]
)
def test_what_tells_the_place_is_dropped_if_phi_drops_it(
    tmp_path: Path, kept: str | None, dropped: tuple[int, ...]
) -> None:
    root = write(tmp_path / "dataset", SIZES | {keys.STATE: 4})
    info = json.loads((root / "meta/info.json").read_text())
    info["features"][keys.STATE]["astra"] = {"role": ["invariant", "position", "position", "heading"]}
    if kept:
        info["features"][keys.ABSTRACT_STATE]["astra"] = {"role": [kept] * 4}
    (root / "meta/info.json").write_text(json.dumps(info))
    reseal(root)
    assert PairedEpisodes.load(root).dropped_place == dropped
    assert not PairedEpisodes.load(
        root, inputs=(keys.STATE,)
    ).dropped_place  # what the encoder is given has other entries


def test_pairs_of_another_task_are_told_with_every_mismatch(tmp_path: Path) -> None:
    sizes = {keys.STATE: 29, keys.GOAL: 2, keys.ACTION: 2} | dict.fromkeys(ABSTRACT, 4)
    ant = TASKS["antmaze-umaze"]
    PairedEpisodes.load(write(tmp_path / "ant", sizes)).check(ant)
    other = PairedEpisodes.load(
        write(tmp_path / "toy", {keys.STATE: 3, keys.GOAL: 5, keys.ACTION: 2} | dict.fromkeys(ABSTRACT, 4))
    )
    with pytest.raises(BadInputError) as caught:
        other.check(ant)
    assert str(caught.value) == (
        "toy@data-1.0.0 has 3 values in a state, antmaze-umaze 29; has 5 values in a goal, antmaze-umaze 2: "
        "pair it again, with the simulator of this task"
    )
    PairedEpisodes.load(
        write(tmp_path / "none", {name: size for name, size in sizes.items() if name != keys.GOAL})
    ).check(ant)  # a simulator is corrected without goals
    wide = write(tmp_path / "wide", {keys.STATE: 29, keys.GOAL: 2, keys.ACTION: 3} | dict.fromkeys(ABSTRACT, 3))
    with pytest.raises(BadInputError, match=r"3 values in an abstract state, .* 4; has 3 values in an action"):
        PairedEpisodes.load(wide).check(ant)
    bounded = {"vx": (-1.0, 2.0), "vy": (-1.0, 1.0)}
    moved = replace(PairedEpisodes.load(tmp_path / "ant"), commands=Commands(bounded))
    with pytest.raises(BadInputError, match=r"was paired for commands within \{'vx': \(-1.0, 2.0\)"):
        moved.check(ant)


def test_commands_are_multiples_of_their_bounds(root: Path, tmp_path: Path) -> None:
    bounds = {"v": (0.0, 1000.0), "w": (-500.0, 500.0)}
    given = PairedEpisodes.load(write(tmp_path / "bounded", SIZES, commands=bounds))
    recorded, mask = PairedEpisodes.load(root).windows.action, given.windows.mask.bool()
    expected = (recorded - torch.tensor([500.0, 0.0])) / 500
    torch.testing.assert_close(given.windows.action[mask], expected[mask])
    assert not given.windows.action[~mask].any() and not given.windows.previous_action[:, 0].any()
    assert given.commands is not None and dict(given.commands) == bounds


DRAWN = torch.tensor([3, 10, 25])


def test_windows_are_steps_in_a_row_inside_their_episodes() -> None:
    torch.manual_seed(0)
    episodes, steps, drawn = draw_steps(DRAWN, 2_000, 8)
    assert (steps.diff(dim=1) == 1).all()
    first, last = steps[:, 0], steps[:, -1]
    short = episodes[:, 0] == 0
    assert (first[short] == 0).all()  # padded at the end
    assert (first >= 0).all() and (last[~short] < DRAWN[episodes[~short, 0]]).all()
    for row in range(3):
        reach = sorted(set(first[episodes[:, 0] == row].tolist()))
        assert reach == list(range(max(1, int(DRAWN[row]) - 7)))
    # Of a window that was drawn across an end only the part inside counts: one stretch of at least a step.
    assert drawn.any(dim=1).all() and (drawn.int().diff(dim=1).abs().sum(1) <= 1).all()
