import os
from pathlib import Path

import numpy as np
import pytest
from fake_dataset import COLUMNS, fake_columns, fake_episode, writer

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, DONE, REWARD, TERMINATED, TRUNCATED, Episode, Scalar
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import Admission


def test_every_fault_of_a_bad_episode_is_reported_and_nothing_is_written(tmp_path: Path) -> None:
    bad = fake_columns(4, seed=0) | {"extra": np.zeros(4, np.float32), "mode": np.zeros(4, bool)}
    del bad[REWARD]
    bad[ACTION] = np.zeros((4, 3), np.float32)
    with pytest.raises(BadInputError) as caught, writer(tmp_path / "set") as open_writer:
        open_writer.add(fake_episode(1, 5))
        open_writer.add(Episode(1, bad, {"return": 1, "length": 4}))
    message = str(caught.value)
    assert "\n" not in message
    for part in (
        "Episode 1",
        "next.reward: missing",
        "extra: unknown column",
        "action: shape (4, 3), expected (T, 2)",
        "mode: dtype bool, expected int64",
        "metadata return: int, earlier episodes have float",
        "metadata length: is filled in by the writer",
        "same uid",
    ):
        assert part in message
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_episode_is_refused() -> None:
    with pytest.raises(
        BadInputError, match=r"expected an Episode, made with Episode\(uid, columns\), got a dict"
    ):
        Admission(COLUMNS).admit(fake_columns(4, seed=1))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "frame", "value", "fault"),
    [
        (DONE, 3, False, "next.done: false in the last frame"),
        (DONE, 1, True, "next.done: true in frame 1, expected in the last one only"),
        (TERMINATED, 0, True, "next.terminated: true in frame 0"),
        (TRUNCATED, 2, True, "next.truncated: true in frame 2"),
    ],
)
def test_only_the_last_step_ends_an_episode(
    tmp_path: Path, name: str, frame: int, value: bool, fault: str
) -> None:
    columns = fake_columns(4, seed=1)
    columns[name][frame] = value
    with writer(tmp_path / "set") as open_writer:
        open_writer.add(fake_episode(1, 4))
        with pytest.raises(BadInputError, match=fault):
            open_writer.add(Episode(2, columns))


@pytest.mark.parametrize("name", [DONE, TERMINATED, TRUNCATED])
def test_flags_of_another_shape_are_a_fault_like_others(name: str) -> None:
    columns = fake_columns(4, seed=1)
    columns[name] = np.stack([columns[name]] * 2, axis=1)
    with pytest.raises(BadInputError, match=rf"Episode 2: {name}: .*\(4, 2\)") as caught:
        Admission(COLUMNS).check(Episode(2, columns))
    assert "\n" not in str(caught.value)


def test_an_episode_is_not_done_without_an_end() -> None:
    columns = fake_columns(4, seed=1)
    for name in (TERMINATED, TRUNCATED):
        columns[name][:] = False
    with pytest.raises(BadInputError, match=r"next\.done: true in the last frame, expected next\.term"):
        Admission(COLUMNS).check(Episode(2, columns))
    columns[TRUNCATED][-1] = True
    Admission(COLUMNS).check(Episode(2, columns))


def test_metadata_keys_keep_the_type_of_their_first_value() -> None:
    admission = Admission(COLUMNS)
    admission.admit(Episode(1, fake_columns(3, seed=1), {"success": True}))
    admission.admit(Episode(2, fake_columns(3, seed=2), {"return": 0.5}))
    assert admission.metadata_types == {"success": bool, "return": float}
    with pytest.raises(BadInputError, match="metadata success: int, earlier episodes have bool"):
        admission.admit(Episode(3, fake_columns(3, seed=3), {"success": 1}))


def test_a_refused_episode_leaves_no_trace() -> None:
    admission = Admission(COLUMNS)
    with pytest.raises(BadInputError, match=r"Episode 1: next\.reward: missing"):
        columns = {name: values for name, values in fake_columns(3, seed=1).items() if name != REWARD}
        admission.admit(Episode(1, columns, {"success": True}))
    assert admission.metadata_types == {}
    admission.admit(Episode(1, fake_columns(3, seed=1)))
    with pytest.raises(BadInputError, match="an earlier episode has the same uid"):
        admission.admit(Episode(1, fake_columns(4, seed=1)))


@pytest.mark.parametrize(
    ("key", "value", "fault"),
    [
        ("serial", 2**63, "metadata serial: an integer of more than 64 bits"),
        ("serial", -(2**63) - 1, "metadata serial: an integer of more than 64 bits"),
        ("log", "a\ud800", r"metadata log: 'a\\ud800' has characters that are not valid Unicode"),
        ("log", os.fsdecode(b"log\xff.csv"), r"metadata log: 'log\\udcff\.csv' has characters that are not"),
        ("log", "x" * (2**20 + 1), r"metadata log: 1,048,577 characters, expected at most 1,048,576"),
        ("", 1, "metadata '': expected a text of valid characters as its name"),
        ("\udc80", 1, r"metadata '\\udc80': expected a text of valid characters as its name"),
    ],
)
def test_metadata_that_no_file_can_hold_is_refused_when_it_is_added(
    tmp_path: Path, key: str, value: int | str, fault: str
) -> None:
    with writer(tmp_path / "set") as open_writer:
        with pytest.raises(BadInputError, match=fault) as caught:
            open_writer.add(Episode(1, fake_columns(4, seed=1), {key: value}))
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 200
        open_writer.add(Episode(1, fake_columns(4, seed=1), {"log": "x" * 2**20, "serial": 2**63 - 1}))
    assert Dataset.open(tmp_path / "set").metadata["serial"] == [2**63 - 1]


def test_metadata_may_be_as_long_and_as_large_as_is_said() -> None:
    metadata: dict[str, Scalar] = {"k" * 2**20: 1, "low": -(2**63), "high": 2**63 - 1, "text": "x" * 2**20}
    Admission(COLUMNS).check(Episode(1, fake_columns(3, seed=1), metadata))
    with pytest.raises(BadInputError, match="expected a text of valid characters as its name"):
        Admission(COLUMNS).check(Episode(1, fake_columns(3, seed=1), {"k" * (2**20 + 1): 1}))


def test_checking_an_episode_leaves_no_trace() -> None:
    admission = Admission(COLUMNS)
    episode = Episode(1, fake_columns(3, seed=1), {"success": True})
    admission.check(episode)
    assert admission.metadata_types == {}
    admission.check(episode)
    admission.admit(episode)
    with pytest.raises(BadInputError, match="an earlier episode has the same uid"):
        admission.check(episode)
