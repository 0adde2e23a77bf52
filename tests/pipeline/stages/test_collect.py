from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_run import COLLECT, TASK
from stopping import Stopped

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, DONE, NEXT_STATE, REWARD, STATE, SUCCESS, TERMINATED, TRUNCATED, Episode
from astra_data.dataset.doctor.check import check
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import StagedWriter
from astra_data.pipeline.stages import collect as stage
from astra_data.pipeline.stages.collect import CollectConfig, begin_drawing, clearance, collect, record
from astra_data.policies.running_policy import PolicyFile, running
from astra_data.robots.registry import TASKS
from astra_data.worlds.task import Task

TINY = CollectConfig(episodes=3, max_steps=15)


def test_episodes_are_whole_and_their_steps_follow_each_other(collected: Path) -> None:
    dataset = Dataset.open(collected)
    assert dataset.reference == f"{TASK}-random-seed0@data-1.0.0" and len(dataset) == COLLECT.episodes
    for index, episode in enumerate(dataset.episodes()):
        columns = episode.columns
        np.testing.assert_array_equal(columns[NEXT_STATE][:-1], columns[STATE][1:])
        assert np.abs(columns[ACTION]).max() <= 1.0
        ended = columns[TERMINATED] | columns[TRUNCATED]
        assert ended[-1] and not ended[:-1].any()
        np.testing.assert_array_equal(columns[DONE], ended)
        assert columns[TERMINATED][-1] == (len(episode) < COLLECT.max_steps)
        assert dataset.metadata["success"][index] == columns[SUCCESS].any()
        assert dataset.metadata["return"][index] == pytest.approx(columns[REWARD].sum(), abs=1e-4)


def test_stress_is_recorded_with_its_reversals(task: str, tmp_path: Path) -> None:
    config = TINY.model_copy(update={"behavior": "stress", "hold_s": (0.05, 0.05)})
    collect(task, config, out=tmp_path / "stress")
    dataset = Dataset.open(tmp_path / "stress")
    assert dataset.description["config"]["behavior"] == "stress"
    commands = [episode.columns[ACTION] for episode in dataset.episodes([ACTION])]
    assert all(np.abs(each).max(axis=1) == pytest.approx(1.0) for each in commands)
    assert any((each[1:] == -each[:-1]).all(axis=1).any() for each in commands)


def test_the_seed_decides_everything_and_the_threads_nothing(task: str, tmp_path: Path) -> None:
    hashes, contents = [], []
    for number, (seed, threads) in enumerate([(1, 1), (1, 2), (2, 2)]):
        out = tmp_path / str(number)
        collect(task, TINY, seed=seed, out=out, num_threads=threads)
        hashes.append(Dataset.open(out).content_hash)
        files = [path for path in sorted(out.rglob("*")) if path.is_file() and path.name != "dataset.json"]
        contents.append([path.read_bytes() for path in files])
    assert hashes[0] == hashes[1] != hashes[2] and contents[0] == contents[1] != contents[2]


@pytest.mark.usefixtures("batches_of_two")
def test_batches_follow_each_other(task: str, tmp_path: Path) -> None:
    batched, two = (
        Dataset.open(collect(task, TINY.model_copy(update={"episodes": count}), out=tmp_path / str(count)))
        for count in (5, 2)
    )
    assert batched.uids.tolist() == [0, 1, 2, 3, 4]
    first, second, *others = batched.episodes()
    for one, other in zip((first, second), two.episodes(), strict=True):
        np.testing.assert_array_equal(one.columns[STATE], other.columns[STATE])
    for name in (STATE, ACTION):  # starts and commands of each batch are its own
        begun = {tuple(episode.columns[name][0].tolist()) for episode in (first, second, *others)}
        assert len(begun) == 5


@pytest.mark.usefixtures("batches_of_two")
def test_an_interrupted_recording_goes_on_to_the_same_bytes(
    task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = TINY.model_copy(update={"episodes": 5})
    collect(task, config, out=tmp_path / "whole")
    add = StagedWriter.add
    told: list[int | None] = []

    def failing(writer: StagedWriter, episode: Episode, position: int | None = None) -> None:
        if len(told) == 3:
            raise KeyboardInterrupt
        add(writer, episode, position)
        told.append(position)

    out = tmp_path / "out"
    monkeypatch.setattr(StagedWriter, "add", failing)
    with pytest.raises(KeyboardInterrupt):
        collect(task, config, out=out)
    monkeypatch.setattr(StagedWriter, "add", add)
    with pytest.raises(BadInputError, match="left 3 episodes; resume it"):
        collect(task, config, out=out, resume=False)
    assert not out.exists()
    collect(task, config, out=out)
    assert Dataset.open(out).content_hash == Dataset.open(tmp_path / "whole").content_hash


@pytest.mark.parametrize(
    ("start", "has_maze", "anywhere"),
    [("task", True, False), (None, True, True), (None, False, False), ("anywhere", True, True)],
)
def test_episodes_begin_where_the_task_does_or_by_default_anywhere_in_a_maze(
    start: str | None, has_maze: bool, anywhere: bool, task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not has_maze:
        monkeypatch.setattr(Task, "plane", None)
    config = TINY.model_copy(update={"start": start, "max_steps": 1})
    collect(task, config, out=tmp_path / "out")
    position = Dataset.open(tmp_path / "out").columns([STATE])[STATE][:, :2]
    near = np.abs(position - [-4.0, 4.0]).max() < 0.7
    assert near == (not anywhere)


@pytest.fixture
def small_training(monkeypatch: pytest.MonkeyPatch) -> None:
    sac = stage._SAC.model_copy(update={"rollout_steps": 8, "updates_per_step": 1, "batch_size": 8})
    small = {"_SAC": sac, "_SAC_SIZES": (8,), "_SAC_ENVS": 4, "_PPO_ENVS": 4, "_TEST_EPISODES": 2}
    for name, value in small.items():
        monkeypatch.setattr(stage, name, value)
    monkeypatch.setattr("astra_data.core.checkpoint.CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(stage, "_SAC_STEPS", 3 * 8 * 4)
    monkeypatch.setattr(stage, "_SAC_EPISODE_STEPS", 71)


@pytest.fixture
def batches_of_two(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "_NUM_ENVS", 2)


@pytest.mark.usefixtures("batches_of_two")
def test_only_as_many_episodes_are_kept_as_have_the_steps(
    task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    every = TINY.model_copy(update={"episodes": 6})
    collect(task, every, out=tmp_path / "all")
    whole = Dataset.open(tmp_path / "all")
    lengths = [len(episode) for episode in whole.episodes([ACTION])]
    steps = sum(lengths[:2]) + 1  # the third episode is needed, the fourth of its batch is not
    some = CollectConfig(**every.model_dump() | {"least_steps": steps})
    batches: list[range] = []

    def counted(*args: Any, **keywords: Any) -> int:
        batches.append(args[3])
        return record(*args, **keywords)

    monkeypatch.setattr("astra_data.pipeline.stages.collect.record", counted)
    collect(task, some, out=tmp_path / "some")
    kept = Dataset.open(tmp_path / "some")
    assert batches == [range(2), range(2, 4)] and [len(episode) for episode in kept.episodes([ACTION])] == lengths[:3]
    for one, other in zip(whole.episodes([ACTION]), kept.episodes([ACTION]), strict=False):
        np.testing.assert_array_equal(one.columns[ACTION], other.columns[ACTION])
    assert kept.description["config"]["least_steps"] == steps
    exactly = some.model_copy(update={"least_steps": sum(lengths[:2])})
    batches.clear()
    collect(task, exactly, out=tmp_path / "exactly")
    assert len(Dataset.open(tmp_path / "exactly")) == 2 and batches == [range(2)]


def test_too_few_episodes_for_the_steps_are_told(task: str, tmp_path: Path) -> None:
    config = TINY.model_copy(update={"episodes": 2, "max_steps": 5, "least_steps": 11})
    with pytest.raises(BadInputError, match=r"least_steps: expected 11, got 10 in 2 episodes: raise episodes"):
        collect(task, config, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("small_training")
@pytest.mark.parametrize("learner", ["ppo", "sac"])
def test_after_interruptions_the_policy_is_not_trained_again(
    learner: str, task: str, lasting: str, tmp_path: Path
) -> None:
    """The first comes in the training, after two of its three iterations, the second while it is recorded."""
    name, settings = {
        "ppo": (task, {"behavior": "suboptimal_ppo", "ppo_steps": 3 * 64 * 4}),
        "sac": (lasting, {"behavior": "suboptimal_sac"}),
    }[learner]
    config = CollectConfig(**settings, episodes=3, max_steps=3)  # type: ignore[arg-type]
    whole, out = tmp_path / "whole", tmp_path / "out"
    collect(name, config, out=whole)

    def notes_until(kind: str, count: int) -> int:
        """Return how many notes on the training there are before the `count`-th note of a `kind` stops it."""
        notes: list[str] = []

        def stop(share: float, note: str) -> None:
            notes.append(note)
            if sum(kind in told for told in notes) == count:
                raise Stopped

        with pytest.raises(Stopped):
            collect(name, config, out=out, progress=stop)
        assert not out.exists()
        return sum("training" in note for note in notes)

    assert notes_until("training", 3) == 3
    with pytest.raises(BadInputError, match="left an unfinished recording; resume it"):
        collect(name, config, out=out, resume=False)
    assert notes_until("target steps/s", 1) == 1 and notes_until("target steps/s", 1) == 0
    collect(name, config, out=out)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]
    policy = "meta/astra/policy.safetensors"
    assert (out / policy).read_bytes() == (whole / policy).read_bytes()
    one, other = Dataset.open(out), Dataset.open(whole)
    assert one.content_hash == other.content_hash
    for key in ("trained_steps", "learner"):
        assert one.description["behavior"][key] == other.description["behavior"][key]
    assert one.description["wall_seconds"] > one.description["behavior"]["spent"]["wall_seconds"] > 0


@pytest.mark.usefixtures("small_training")
def test_the_policy_that_acted_is_kept(lasting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = CollectConfig(behavior="suboptimal_sac", start="task", episodes=3, max_steps=3)
    first = Dataset.open(collect(lasting, config, out=tmp_path / "first"))
    kept = PolicyFile.load(first.root / "meta/astra/policy.safetensors")
    monkeypatch.setattr(stage, "suboptimal_by_sac", lambda *_, **__: (kept, {}))
    second = Dataset.open(collect(lasting, config, out=tmp_path / "second"))
    assert second.content_hash == first.content_hash
    report = check(first.root)
    assert not report.notes and not report.faults
    policy, state = running(TASKS[lasting], kept), first.columns([STATE])[STATE][:1]
    drawn = []
    for seed in (0, 1):  # the mean would be the same
        drawn.append(begin_drawing(policy, 1, seed)(torch.from_numpy(state), torch.zeros(1, 0)).tolist())
    assert drawn[0] != drawn[1]


@pytest.fixture
def lasting() -> Iterator[str]:
    usual = TASKS["humanoid-kinematics"]
    name = "humanoid-short"
    TASKS[name] = replace(usual, name=name, objective=replace(usual.objective, horizon=70))
    yield name
    del TASKS[name]


def test_commands_that_lead_to_walls_are_replaced_where_it_is_asked_for(task: str, tmp_path: Path) -> None:
    foreseen = {}
    for clearance_m in (0.0, 1.0):
        settings = {"hold_s": (0.05, 0.05), "clearance_m": clearance_m}
        out = tmp_path / str(clearance_m)
        collect(task, TINY.model_copy(update=settings), out=out)
        columns = Dataset.open(out).columns([STATE, ACTION])
        commands = columns[ACTION][:, None].astype(np.float64)
        near = clearance(TASKS[task], torch.from_numpy(columns[STATE]), commands) < 1.0
        foreseen[clearance_m] = near.mean()
    assert foreseen[1.0] < 0.5 * foreseen[0.0]
