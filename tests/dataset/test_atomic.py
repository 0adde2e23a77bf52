import errno
import multiprocessing
import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from itertools import count
from pathlib import Path

import pytest
from failing_disk import failing
from racing import ROUNDS, race

from astra_data.core.durable import held
from astra_data.core.errors import BadInputError, DiskError
from astra_data.dataset.atomic import atomic_file, atomic_folder, refuse_existing


@pytest.mark.parametrize("writing", [atomic_folder, atomic_file])
def test_a_place_that_cannot_be_written_is_told(
    tmp_path: Path, writing: Callable[[Path], AbstractContextManager[Path]]
) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(DiskError, match=r"set cannot be written: a file is where its folder would be"),
        writing(tmp_path / "file" / "set"),
    ):
        pass


def test_an_error_inside_is_not_swallowed_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_folder(tmp_path / "set"):
        raise FileNotFoundError
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("writing", [atomic_folder, atomic_file])
def test_nothing_is_overwritten(
    tmp_path: Path, writing: Callable[[Path], AbstractContextManager[Path]]
) -> None:
    target = tmp_path / "set"

    def write(path: Path, text: str) -> None:
        (path / "file" if path.is_dir() else path).write_text(text)

    with writing(target) as path:
        write(path, "first")
        assert path.relative_to(tmp_path).parts[0].startswith(".set.tmp-")
        assert not target.exists()
    with pytest.raises(BadInputError, match="exists already"), writing(target):
        raise AssertionError("refused before anything is written")
    other = tmp_path / "other"
    with pytest.raises(BadInputError, match="exists already"), writing(other) as path:
        write(path, "second")
        other.mkdir()
        (other / "file").write_text("third")
    assert (other / "file").read_text() == "third"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other", "set"]


def test_a_folder_that_another_process_made_meanwhile_is_left_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def late(_folder: Path, target: Path) -> None:
        (target / "theirs").mkdir(parents=True)
        raise OSError(errno.ENOTEMPTY, "Directory not empty")

    monkeypatch.setattr(os, "replace", late)
    with pytest.raises(BadInputError, match="set exists already"), atomic_folder(tmp_path / "set"):
        pass
    assert [path.name for path in tmp_path.rglob("*")] == ["set", "theirs"]


def test_a_link_to_nothing_is_not_overwritten(tmp_path: Path) -> None:
    refuse_existing(tmp_path / "set")
    (tmp_path / "set").symlink_to(tmp_path / "nothing")
    with pytest.raises(BadInputError, match="exists already; delete it or choose another folder"):
        refuse_existing(tmp_path / "set")


def test_only_the_folders_of_dead_processes_are_removed(tmp_path: Path) -> None:
    for name in (".set.tmp-1", ".set.tmp-2-1", ".sets.tmp-1"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").touch()
    with held(tmp_path / ".set.tmp-2-1"), atomic_folder(tmp_path / "set"):
        left = {path.name for path in tmp_path.iterdir()}
    assert {".set.tmp-2-1", ".sets.tmp-1"} < left
    assert ".set.tmp-1" not in left


def test_what_a_killed_export_left_is_swept_by_the_next(tmp_path: Path) -> None:
    (tmp_path / ".out.hdf5.tmp-1").mkdir()
    (tmp_path / ".out.hdf5.tmp-1" / "out.hdf5").touch()
    with atomic_file(tmp_path / "out.hdf5") as path:
        path.write_text("whole")
    assert [path.name for path in tmp_path.iterdir()] == ["out.hdf5"]


@pytest.mark.usefixtures("fsync")
def test_a_disk_that_fails_at_any_operation_leaves_all_or_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    for at in count():
        target = tmp_path / f"at_{at}"
        with failing("mkdir rename replace unlink rmdir fsync", at, OSError(errno.EIO, "fault")) as calls:
            try:
                with atomic_folder(target) as folder:
                    (folder / "file").write_text("whole")
            except DiskError as error:
                assert str(error).startswith(f"{target} cannot be written: the disk reports an error.")
        if target.exists():
            assert (target / "file").read_text() == "whole"
        if len(calls) <= at:
            break
    assert at > 5


def test_racing_processes_make_each_folder_once(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    racers = [context.Process(target=race, args=(tmp_path,)) for _ in range(3)]
    for racer in racers:
        racer.start()
    for racer in racers:
        racer.join()
    assert [racer.exitcode for racer in racers] == [0, 0, 0]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(map(str, range(ROUNDS)))
