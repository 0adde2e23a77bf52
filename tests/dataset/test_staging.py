import errno
import os
import shutil
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from failing_disk import Killed, failing, small_files
from fake_dataset import COLUMNS, DESCRIPTION, fake_episode, fake_episodes, staged_writer, write_fake
from shared_files import contents

from astra_data.core.errors import AstraDataError, BadInputError, CorruptDatasetError, DiskError
from astra_data.dataset import Dataset
from astra_data.dataset.columns import REWARD, Episode


def leftovers(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


def interrupted(root: Path, episodes: list[Episode]) -> None:
    with pytest.raises(RuntimeError), staged_writer(root) as writer:
        for episode in episodes:
            writer.add(episode)
        raise RuntimeError


def test_a_recording_is_the_dataset_that_is_written_at_once(tmp_path: Path) -> None:
    with staged_writer(tmp_path / "set") as writer:
        for episode in fake_episodes():
            writer.add(episode)
    assert contents(tmp_path / "set") == contents(write_fake(tmp_path / "whole").root) and leftovers(tmp_path) == []


def test_positions_order_the_episodes(tmp_path: Path) -> None:
    episodes = fake_episodes()
    with staged_writer(tmp_path / "set") as writer:
        for position in (3, 0, 4, 2, 1):
            writer.add(episodes[position], position)
        with pytest.raises(BadInputError, match="there is an episode 3 already"):
            writer.add(fake_episode(99, 3), 3)
    assert Dataset.open(tmp_path / "set").uids.tolist() == [episode.uid for episode in episodes]


def test_an_interrupted_recording_goes_on(tmp_path: Path) -> None:
    episodes = fake_episodes()
    interrupted(tmp_path / "set", episodes[:3])
    assert not (tmp_path / "set").exists()
    with pytest.raises(BadInputError, match="left 3 episodes; resume it"), staged_writer(tmp_path / "set"):
        pass
    with staged_writer(tmp_path / "set", resume=True) as writer:
        assert sorted(writer.staged) == [0, 1, 2]
        with pytest.raises(BadInputError, match="same uid"):
            writer.add(episodes[0])
        for episode in episodes[3:]:
            writer.add(episode)
    assert contents(tmp_path / "set") == contents(write_fake(tmp_path / "whole").root)


def test_another_recording_is_not_mixed_in(tmp_path: Path) -> None:
    interrupted(tmp_path / "set", [fake_episode(1, 4)])
    description = {"name": "fake", "stage": "collect", "config": {"episodes": 6, "noise_m": 0.1}}
    changes = {"description": description, "columns": COLUMNS[1:]}
    with (
        pytest.raises(BadInputError, match=r"differs in columns.observation.state, description.config.episodes"),
        staged_writer(tmp_path / "set", resume=True, **changes),
    ):
        pass
    with staged_writer(tmp_path / "set", resume=True) as writer:
        assert sorted(writer.staged) == [0]


def test_two_processes_do_not_record_the_same(tmp_path: Path) -> None:
    with staged_writer(tmp_path / "set") as writer:
        writer.add(fake_episode(1, 4))
        second = staged_writer(tmp_path / "set", resume=True)
        with pytest.raises(BadInputError, match="is being recorded right now"), second:
            pass


def test_a_damaged_episode_is_told(tmp_path: Path) -> None:
    episode = fake_episode(1, 4)
    interrupted(tmp_path / "set", [episode])
    path = tmp_path / ".set.staged/000000.arrow"
    whole = path.read_bytes()
    at = whole.index(episode.columns[REWARD].tobytes())
    for content, fault in (
        (whole[:-50], "is no whole episode"),
        (bytes([whole[at] ^ 1]).join([whole[:at], whole[at + 1 :]]), r"was altered in next\.reward; delete it"),
    ):
        path.write_bytes(content)
        again = staged_writer(tmp_path / "set", resume=True)
        with pytest.raises(CorruptDatasetError, match=rf"000000\.arrow {fault}"), again:
            pass


def test_another_dataset_in_its_place_does_not_cost_the_recording(tmp_path: Path) -> None:
    interrupted(tmp_path / "set", [*fake_episodes()[:2], fake_episode(6, 31)])
    write_fake(tmp_path / "set")
    again = staged_writer(tmp_path / "set", resume=True)
    with pytest.raises(BadInputError, match="interrupted recording, which left 3 episodes in"), again:
        pass
    assert len(list((tmp_path / ".set.staged").glob("*.arrow"))) == 3


def test_what_was_prepared_is_kept_after_an_error_and_lost_to_no_other_dataset(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), staged_writer(tmp_path / "set") as writer:
        for name in ("training.safetensors", ".written"):  # the hash of what was not published
            (writer.folder / name).write_text("half")
        raise RuntimeError
    with pytest.raises(BadInputError, match="left an unfinished recording; resume it"), staged_writer(tmp_path / "set"):
        pass
    write_fake(tmp_path / "set", description={**DESCRIPTION, "name": "other"})
    again = staged_writer(tmp_path / "set", resume=True)
    with pytest.raises(BadInputError, match=r"another dataset .* which left an unfinished recording in"), again:
        pass
    assert (tmp_path / ".set.staged" / "training.safetensors").read_text() == "half"


def test_an_episode_is_on_the_disk_itself_before_it_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[str] = []
    monkeypatch.setattr("astra_data.core.durable.sync", lambda path: synced.append(path.name))
    with staged_writer(tmp_path / "new" / "set") as writer:
        assert {tmp_path.name, "new", "plan.json", ".set.staged"} <= {*synced}
        synced.clear()
        writer.add(fake_episode(1, 4))
        assert synced == ["000000.partial", ".set.staged"]


def test_a_kill_in_any_operation_never_mixes_two_recordings(tmp_path: Path) -> None:
    other = {**DESCRIPTION, "seeds": {"collect": 1}}
    episodes, others = fake_episodes()[:2], [fake_episode(uid, 9) for uid in (20, 21, 22)]
    whole = contents(write_episodes(tmp_path / "whole", episodes))
    second = contents(write_episodes(tmp_path / "second", others, description=other))
    for at in count():
        root = tmp_path / f"at_{at}" / "set"
        with suppress(Killed), failing("mkdir rename replace unlink rmdir", at, Killed(), Killed()) as calls:
            write_episodes(root, episodes)
        root.parent.mkdir(exist_ok=True)
        shutil.copytree(root.parent, tmp_path / f"without_{at}")
        without = tmp_path / f"without_{at}" / "set"
        shutil.rmtree(without, ignore_errors=True)

        if root.exists():
            with pytest.raises(BadInputError, match="exists already; delete it"):
                write_episodes(root, episodes)
        else:
            write_episodes(root, episodes)
        assert contents(root) == whole and leftovers(root.parent) == []

        try:
            write_episodes(without, others, description=other)
        except BadInputError as error:
            assert "differs in description.seeds.collect; resume it with the same settings" in str(error)
            assert not without.exists()
            shutil.rmtree(without.with_name(".set.staged"))
            write_episodes(without, others, description=other)
        assert contents(without) == second and leftovers(without.parent) == []
        if len(calls) <= at:
            break
    assert at > 15


@pytest.mark.parametrize("plan", [None, "", "{", "[]"])
def test_staged_episodes_of_an_unknown_recording_are_refused(tmp_path: Path, plan: str | None) -> None:
    interrupted(tmp_path / "set", fake_episodes()[:2])
    path = tmp_path / ".set.staged" / "plan.json"
    path.unlink()
    if plan is not None:
        path.write_text(plan)
    again = staged_writer(tmp_path / "set", resume=True)
    with pytest.raises(BadInputError, match=r"holds 2 episodes, but plan\.json is .*delete the folder"), again:
        pass
    assert len(list((tmp_path / ".set.staged").glob("*.arrow"))) == 2


def test_on_a_full_disk_the_episodes_are_safe_and_the_recording_goes_on(tmp_path: Path) -> None:
    episodes = fake_episodes()
    long = fake_episode(99, 3000)
    with pytest.raises(DiskError) as caught, staged_writer(tmp_path / "set") as writer:
        writer.add(episodes[0])
        with small_files(20_000):
            writer.add(long)
    assert str(caught.value) == (
        f"{tmp_path / '.set.staged' / '000001.arrow'} cannot be written: a file would be larger than is "
        "allowed. What was finished before is safe: raise the limit (ulimit -f), then run the same command "
        f"again. 1 episodes are safe in {tmp_path / '.set.staged'}: a recipe goes on with them by itself, "
        "the command for a task with --resume."
    )
    with staged_writer(tmp_path / "set", resume=True) as writer:
        assert list(writer.staged) == [0]
        with small_files(20_000), pytest.raises(DiskError):
            writer.add(long)
        writer.add(long)
    assert Dataset.open(tmp_path / "set").uids.tolist() == [episodes[0].uid, 99] and leftovers(tmp_path) == []


@pytest.mark.usefixtures("fsync")
def test_a_disk_that_fails_at_any_operation_loses_no_episode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    episodes = fake_episodes()[:2]
    whole = contents(write_episodes(tmp_path / "whole", episodes))
    at = 0
    while True:
        root = tmp_path / f"at_{at}" / "set"
        with failing("mkdir rename replace unlink rmdir fsync", at, OSError(errno.ENOSPC, "full")) as calls:
            try:
                write_episodes(root, episodes)
            except AstraDataError as error:
                assert isinstance(error, DiskError) and f"{root.parent}" in str(error)
        if not root.exists():
            write_episodes(root, episodes)
        assert contents(root) == whole
        if len(calls) <= at:
            break
        at += 1 if calls[at] != "fsync" else 3  # most are the finished dataset's files, one after another


def write_episodes(root: Path, episodes: list[Episode], **changes: Any) -> Path:
    """Record `episodes`, or go on with it."""
    with staged_writer(root, resume=True, **changes) as writer:
        for position, episode in enumerate(episodes):
            if position not in writer.staged:
                writer.add(episode, position)
    return root
