import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fake_dataset import COLUMNS, DESCRIPTION, fake_episode, fake_episodes, staged_writer, write_fake

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset import Dataset
from astra_data.dataset.columns import Episode

STEPS_OF_THE_RECORDED = 20
EPISODES_OF_THE_RECORDED = 30


def files(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def leftovers(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


def test_a_recording_is_the_dataset_that_is_written_at_once(tmp_path: Path) -> None:
    with staged_writer(tmp_path / "set") as writer:
        for episode in fake_episodes():
            writer.add(episode)
    assert files(tmp_path / "set") == files(write_fake(tmp_path / "whole").root)
    assert leftovers(tmp_path) == []


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
    with pytest.raises(RuntimeError), staged_writer(tmp_path / "set") as writer:
        for episode in episodes[:3]:
            writer.add(episode)
        raise RuntimeError
    assert not (tmp_path / "set").exists()
    with pytest.raises(BadInputError, match="left 3 episodes; resume it"), staged_writer(tmp_path / "set"):
        pass
    with staged_writer(tmp_path / "set", resume=True) as writer:
        assert sorted(writer.staged) == [0, 1, 2]
        with pytest.raises(BadInputError, match="same uid"):
            writer.add(episodes[0])
        for episode in episodes[3:]:
            writer.add(episode)
    assert files(tmp_path / "set") == files(write_fake(tmp_path / "whole").root)


def test_another_recording_is_not_mixed_in(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), staged_writer(tmp_path / "set") as writer:
        writer.add(fake_episode(1, 4))
        raise RuntimeError
    description = {"name": "fake", "stage": "collect", "config": {"episodes": 6, "noise_m": 0.1}}
    changes = {"description": description, "columns": COLUMNS[1:]}
    with (
        pytest.raises(
            BadInputError, match=r"differs in columns.observation.state, description.config.episodes"
        ),
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


def test_a_refused_episode_changes_nothing(tmp_path: Path) -> None:
    with staged_writer(tmp_path / "set") as writer:
        for episode in fake_episodes():
            writer.add(episode)
        with pytest.raises(BadInputError, match=r"next.reward: missing"):
            writer.add(Episode(7, {"mode": np.arange(4)}))
    assert files(tmp_path / "set") == files(write_fake(tmp_path / "whole").root)


def test_without_episodes_nothing_is_left(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="no episodes were added"), staged_writer(tmp_path / "set"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_episode_is_told(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), staged_writer(tmp_path / "set") as writer:
        writer.add(fake_episode(1, 4))
        raise RuntimeError
    path = tmp_path / ".set.staged/000000.arrow"
    path.write_bytes(path.read_bytes()[:-50])
    again = staged_writer(tmp_path / "set", resume=True)
    with pytest.raises(CorruptDatasetError, match=r"000000\.arrow is no whole episode"), again:
        pass


def interrupted(root: Path, episodes: list[Episode]) -> None:
    with pytest.raises(RuntimeError), staged_writer(root) as writer:
        for episode in episodes:
            writer.add(episode)
        raise RuntimeError


def test_what_a_kill_after_the_end_left_is_cleared(tmp_path: Path) -> None:
    interrupted(tmp_path / "set", fake_episodes())
    write_fake(tmp_path / "set")
    with pytest.raises(BadInputError, match="exists already; delete it"), staged_writer(tmp_path / "set"):
        pass
    assert leftovers(tmp_path) == []


def test_another_dataset_in_its_place_does_not_cost_the_recording(tmp_path: Path) -> None:
    interrupted(tmp_path / "set", [*fake_episodes()[:2], fake_episode(6, 31)])
    write_fake(tmp_path / "set")
    again = staged_writer(tmp_path / "set", resume=True)
    with pytest.raises(BadInputError, match="interrupted recording, which left 3 episodes in"), again:
        pass
    assert len(list((tmp_path / ".set.staged").glob("*.arrow"))) == 3


def test_what_was_prepared_is_kept_after_an_error_and_lost_to_no_other_dataset(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), staged_writer(tmp_path / "set") as writer:
        (writer.folder / "training.safetensors").write_text("half")
        raise RuntimeError
    with (
        pytest.raises(BadInputError, match="left an unfinished recording; resume it"),
        staged_writer(tmp_path / "set"),
    ):
        pass
    write_fake(tmp_path / "other", description={**DESCRIPTION, "name": "other"})
    (tmp_path / "other").rename(tmp_path / "set")
    again = staged_writer(tmp_path / "set", resume=True)
    with (
        pytest.raises(BadInputError, match=r"another dataset .* which left an unfinished recording in"),
        again,
    ):
        pass
    assert (tmp_path / ".set.staged" / "training.safetensors").read_text() == "half"


def test_a_dataset_that_comes_between_does_not_cost_the_recording(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="exists already"), staged_writer(tmp_path / "set") as writer:
        writer.add(fake_episode(1, 4))
        (tmp_path / "set").mkdir()
    assert len(list((tmp_path / ".set.staged").glob("*.arrow"))) == 1


def test_an_episode_is_on_the_disk_itself_before_it_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    for module in ("dataset.staging", "core.durable"):
        monkeypatch.setattr(f"astra_data.{module}.sync", lambda path: synced.append(path.name))
    with staged_writer(tmp_path / "new" / "set") as writer:
        assert {tmp_path.name, "new", "plan.json", ".set.staged"} <= {*synced}
        synced.clear()
        writer.add(fake_episode(1, 4))
        assert synced == ["000000.partial", ".set.staged"]


def test_a_kill_at_any_moment_loses_no_finished_episode(tmp_path: Path) -> None:
    record(tmp_path / "whole")
    whole = files(tmp_path / "whole")
    rng = np.random.default_rng(0)
    for trial in range(10):
        root = tmp_path / f"set_{trial}"
        command = [sys.executable, __file__, str(root)]
        path = {"PYTHONPATH": os.pathsep.join(sys.path)}
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | path) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "begun\n"
            time.sleep(rng.uniform(0.0, 0.15))
            process.send_signal(signal.SIGKILL)
            added = process.stdout.read().split()
        if root.exists():
            assert Dataset.open(root).verify() == []
            assert len(added) == EPISODES_OF_THE_RECORDED
        else:
            staged = {path.stem for path in root.with_name(f".{root.name}.staged").glob("*.arrow")}
            assert staged >= set(added)
            record(root)
        assert files(root) == whole


def record(root: Path) -> None:
    """Record, or go on with it, and print which episodes are safe."""
    with staged_writer(root, resume=True) as writer:
        for position in range(EPISODES_OF_THE_RECORDED):
            if position not in writer.staged:
                writer.add(fake_episode(position, STEPS_OF_THE_RECORDED), position)
                os.write(1, f"{position:06d}\n".encode())


if __name__ == "__main__":
    os.write(1, b"begun\n")
    record(Path(sys.argv[1]))
