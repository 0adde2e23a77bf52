"""What lerobot itself recorded is taken by every command, as a dataset of ours is."""

import json
import logging
import shutil
from pathlib import Path

import numpy as np
import pytest
from damaged import DATA, alter_rows
from fake_dataset import write_transitions
from lerobot_recordings import JOINTS, values
from typer.testing import CliRunner

from astra_data.cli.app import app
from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset import Dataset
from astra_data.dataset import columns as keys
from astra_data.dataset.doctor.check import check
from astra_data.dataset.doctor.repair import repair
from astra_data.dataset.lerobot_recording import RECORDED_TASK
from astra_data.io.hub.sharing import push

KEPT = (0, 2, 3)
"""Episodes of `arm` with a next state."""


@pytest.fixture
def arm(recorded: Path) -> Dataset:
    return Dataset.open(recorded / "arm")


def test_next_states_are_those_of_the_following_rows(arm: Dataset) -> None:
    assert arm.uids.tolist() == list(KEPT) and arm.lengths.tolist() == [5, 8, 3]
    for number, episode in zip(KEPT, arm.episodes(), strict=True):
        expected = values("arm", number)
        np.testing.assert_array_equal(episode.columns[keys.STATE], expected[keys.STATE][:-1])
        np.testing.assert_array_equal(episode.columns[keys.NEXT_STATE], expected[keys.STATE][1:])
        for name in (keys.ACTION, keys.REWARD):
            np.testing.assert_array_equal(episode.columns[name], expected[name][:-1])
        np.testing.assert_array_equal(episode.columns["force"], expected["force"][:-1].astype(np.float32))
        last = np.arange(len(episode)) == len(episode) - 1
        # The row that is left out is done: the step before takes over its success.
        np.testing.assert_array_equal(episode.columns[keys.SUCCESS], last & expected[keys.SUCCESS][-1])
        assert not episode.columns[keys.TERMINATED].any()
        np.testing.assert_array_equal(episode.columns[keys.TRUNCATED], last)
        np.testing.assert_array_equal(episode.columns[keys.DONE], last)
        assert set(episode.columns[RECORDED_TASK]) == {number % 2}
    assert arm.metadata == {"success": [True, False, True], "task": ["lift", "lift", "turn"]}
    assert arm.specs([keys.NEXT_STATE])[0].names == tuple(JOINTS) and (arm.task, arm.info["fps"]) == ("lift / turn", 10)
    assert arm.description["environment"] == {"robot_type": "so101"}
    pictures = arm.pictures("observation.images.top", 1)
    assert pictures.shape == (8, 8, 8, 3) and pictures[:, 0, 0, 0].tolist() == [9 * step for step in range(8)]


def test_what_is_left_out_is_said_in_one_line(recorded: Path, caplog: pytest.LogCaptureFixture) -> None:
    Dataset.open(recorded / "arm")
    [line] = caplog.messages
    assert "the last row of each episode, 4 of 20 rows; 1 of them in episodes of a single row" in line
    assert "images" not in line
    assert "\n" not in line and caplog.records[0].levelno == logging.WARNING and "succeeded" not in line
    reward = sum(float(values("arm", number)[keys.REWARD][-1]) for number in range(4))
    assert f"with the last rows a reward of {reward:g} in sum is left out" in line
    assert line.count(" here, recorded as ") == 1 and line.endswith("; force is float32 here, recorded as float64")


def test_repaired_it_is_as_it_was_opened(arm: Dataset, recorded: Path, tmp_path: Path) -> None:
    notes = repair(arm.root, out=tmp_path / "whole").notes
    whole = Dataset.open(tmp_path / "whole")
    assert (whole.content_hash, whole.schema, whole.task) == (arm.content_hash, arm.schema, arm.task)
    assert (whole.uids.tolist(), whole.metadata) == (arm.uids.tolist(), arm.metadata)
    assert whole.description["environment"] == {"robot_type": "so101"}
    [note] = [note for note in notes if note.startswith("next states are those of the following rows")]
    assert "the last row of each episode, 4 of 20 rows; 1 of them in episodes of a single row" in note
    assert check(whole.root).faults == []
    repair(arm.root, out=tmp_path / "renamed", new_uids=True)
    assert Dataset.open(tmp_path / "renamed").content_hash == arm.content_hash


def test_what_cannot_be_is_one_line(recorded: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"blind, recorded by LeRobot, has no observation\.state"):
        Dataset.open(recorded / "blind")
    with pytest.raises(BadInputError, match="1 episodes have the episode_uid of an earlier one"):
        Dataset.open(recorded / "merged")
    with pytest.raises(BadInputError, match="recorded by LeRobot: make a dataset of it first"):
        push(recorded / "arm", str(tmp_path / "shared"))
    with pytest.raises(BadInputError, match=r"arm holds other rows: first `astra-data subset .*arm --percent 100`"):
        Dataset.open(recorded / "arm").to_huggingface()
    shutil.copytree(recorded / "ant", tmp_path / "old")
    info = tmp_path / "old/meta/info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"codebase_version": "v2.1"}))
    with pytest.raises(BadInputError, match=r"format v2\.1, expected v3\.0: convert it"):
        Dataset.open(tmp_path / "old")
    shutil.copytree(recorded / "arm", tmp_path / "torn")
    (tmp_path / "torn/meta/tasks.parquet").write_bytes(b"PAR1")
    with pytest.raises(CorruptDatasetError, match=r"altered: meta/tasks\.parquet "):
        Dataset.open(tmp_path / "torn")


@pytest.mark.parametrize(
    ("column", "changes", "fault"),
    [
        (keys.ACTION, {3: [float("nan"), 0.0]}, "action is nan in episode 0 frame 3"),
        ("frame_index", {70: 3}, "frame_index is 3 in episode 1 frame 10, expected 10"),
    ],
)
def test_damage_is_found_before_anything_is_made_of_it(
    recorded: Path, tmp_path: Path, column: str, changes: dict[int, object], fault: str
) -> None:
    shutil.copytree(recorded / "ant", tmp_path / "set")
    alter_rows(tmp_path / "set" / DATA, column, changes)
    with pytest.raises(CorruptDatasetError, match=fault):
        Dataset.open(tmp_path / "set")


def test_a_dataset_of_ours_without_its_metadata_keeps_uids_and_next_states(tmp_path: Path) -> None:
    ours = write_transitions(tmp_path / "set")
    bare = Dataset.open(shutil.copytree(ours.root, tmp_path / "bare", ignore=shutil.ignore_patterns("astra")))
    assert bare.uids.tolist() == ours.uids.tolist() and bare.content_hash == ours.content_hash


def test_a_merge_of_lerobot_keeps_every_episode_under_new_uids(recorded: Path, tmp_path: Path) -> None:
    sources = [Dataset.open(recorded / name) for name in ("a", "b")]
    arguments = ["repair", str(recorded / "merged"), "--out", str(tmp_path / "set"), "--new-uids"]
    for source in sources:
        arguments += ["--like", str(source.root)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert "1 episodes have new uids, because theirs were taken" in result.output
    saved = Dataset.open(tmp_path / "set")
    uids = saved.uids.tolist()
    assert uids[:5] + uids[6:] == [*sources[0].uids.tolist(), 7] and len(set(uids)) == 7
    merged = [episode for source in sources for episode in source.episodes()]
    for found, expected in zip(saved.episodes(), merged, strict=True):
        for name, array in expected.columns.items():
            np.testing.assert_array_equal(found.columns[name], array, err_msg=name)
    assert saved.metadata["return"] == [*sources[0].metadata["return"], -1.0, -1.0]
    assert saved.metadata["merged_uid"] == [None] * 5 + [13, None]
    # Both came from episode 13 of `b`, which has another uid now; those of `a` follow their own.
    assert saved.metadata["source_episode"][5:] == [uids[5], uids[5]]
    assert saved.metadata["source_episode"][:5] == sources[0].metadata["source_episode"]
    assert saved.description["parents"] == [source.identity for source in sources]
    repair(recorded / "merged", out=tmp_path / "again", like=sources, new_uids=True)
    assert Dataset.open(tmp_path / "again").uids.tolist() == uids
