import errno
import os
from itertools import count
from pathlib import Path

import pytest
from failing_disk import Killed, failing

from astra_data.core import durable
from astra_data.core.errors import BadInputError, DiskError

pytestmark = pytest.mark.usefixtures("fsync")
MUTATING = "mkdir rename replace unlink rmdir fsync"


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "full"), Killed()])
def test_a_disk_that_fails_or_a_kill_at_any_operation_leaves_the_old_file_or_the_new_one(
    tmp_path: Path, error: BaseException
) -> None:
    path = tmp_path / "walks[1]"  # a name that would be a pattern
    for at in count():
        durable.write_file(path, "old é")
        with failing(MUTATING, at, error, error if isinstance(error, Killed) else None) as calls:
            try:
                durable.write_file(path, b"\0new")
            except (DiskError, Killed) as raised:
                assert isinstance(raised, Killed) or f"{path} cannot be written: the disk is full." in str(raised)
                assert path.read_bytes() in ("old é".encode(), b"\0new")
            else:
                assert path.read_bytes() == b"\0new"
        if len(calls) <= at:
            break
    assert at > 5
    durable.write_file(path, "last")
    assert names(tmp_path) == [path.name]


def test_what_is_no_plain_file_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    fifo = tmp_path / "pipe"
    os.mkfifo(fifo)
    reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    durable.write_file(fifo, "through")
    assert os.read(reader, 100) == b"through"
    os.close(reader)
    assert fifo.is_fifo()
    link, (reader, stdout) = tmp_path / "link", os.pipe()
    (tmp_path / "stdout").symlink_to(f"/dev/fd/{stdout}")
    durable.write_file(tmp_path / "stdout", "shown")
    assert os.read(reader, 100) == b"shown"
    os.close(reader)
    os.close(stdout)
    link.symlink_to("linked")
    for text in ("first", "second"):
        durable.write_file(link, text)
        assert link.is_symlink() and (tmp_path / "linked").read_text() == text
    (tmp_path / "folder").mkdir()
    with pytest.raises(DiskError, match="is a directory"):
        durable.write_file(tmp_path / "folder", "text")


def test_the_disk_has_each_file_before_its_name_and_each_name_before_the_end(
    tmp_path: Path, disk_order: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    durable.write_file(tmp_path / "new" / "file", "text")
    assert disk_order == [f"fsync {tmp_path.name}", "fsync file", "replace", "fsync new"]
    disk_order.clear()
    durable.make_folder(tmp_path / "a" / "b")
    assert sorted(disk_order) == sorted([f"fsync {tmp_path.name}", "fsync a"])
    disk_order.clear()
    durable.sync_tree(tmp_path / "new")
    assert sorted(disk_order) == ["fsync file", "fsync new"]
    monkeypatch.setenv(durable.NO_FSYNC, "1")
    disk_order.clear()
    durable.write_file(tmp_path / "file", "text")
    assert disk_order == ["replace"]


def test_a_folder_is_whole_or_gone_whenever_its_removal_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / ".set.staged"
    for at in count():
        (folder / "deep").mkdir(parents=True)
        for name in ("plan", "deep/1", "deep/2"):
            (folder / name).touch()
        with failing(MUTATING, at, Killed(), Killed()) as calls:
            try:
                durable.discard(folder, tmp_path / "set")
            except Killed:
                if folder.exists():
                    assert sorted(path.name for path in folder.rglob("*")) == ["1", "2", "deep", "plan"]
        if len(calls) <= at:
            break
        if folder.exists():
            durable.discard(folder, tmp_path / "set")
    assert at > 5
    durable.clean(tmp_path)
    assert names(tmp_path) == []


def test_a_failure_removes_the_folders_that_were_made_for_it_alone(tmp_path: Path) -> None:
    home = tmp_path / "home"
    with pytest.raises(FileNotFoundError), durable.atomic_folder(home / "of/walks/data-1.0.0"):
        raise FileNotFoundError
    with pytest.raises(DiskError):
        durable.write_file(home / ("walks" * 100) / "notes.txt", "its name is too long")
    assert not home.exists()
    home.mkdir()
    with pytest.raises(KeyError), durable.hidden_folder(home / "walks/data-1.0.0"):
        durable.write_file(home / "walks/notes.txt", "of somebody else")
        raise KeyError
    assert [path.name for path in (home / "walks").iterdir()] == ["notes.txt"]


def test_what_a_command_goes_on_with_is_beside_its_target(tmp_path: Path) -> None:
    others = (".set.tmp-12", ".set.old", ".set2.partial", "set", "set.partial")
    for name in (".set.staged", ".set.partial", *others):
        (tmp_path / name).mkdir()
    assert durable.begun_beside(tmp_path / "set") == [tmp_path / ".set.partial", tmp_path / ".set.staged"]
    assert durable.begun_beside(tmp_path / "none") == []


def test_cleaning_spares_what_lives_and_what_is_resumed(tmp_path: Path) -> None:
    home = tmp_path / "home"
    dead = home / "ant" / ".data-1.0.0.tmp-12"
    alive, staged = home / ".set.tmp-13-1", home / ".set.staged"
    for folder in (dead / "data", alive, staged, home / ".git", home / "set.tmp-1"):
        folder.mkdir(parents=True)
    for file in (".out.hdf5.tmp-99", ".notes.partial", "file"):
        (home / file).touch()
    (dead / "data" / "file").touch()
    os.mkfifo(home / ".pipe.tmp-98")
    with durable.held(alive):
        durable.clean(home)
    assert names(home) == [".git", ".notes.partial", ".set.staged", alive.name, "ant", "file", "set.tmp-1"]
    assert names(home / "ant") == []
    durable.clean(tmp_path / "none")


def test_the_fault_that_hdf5_hides_in_its_text_is_found() -> None:
    text = "Can't decrement id ref count (file write failed: time = Mon\n, filename = 'x', errno = 28, error"
    with (
        pytest.raises(DiskError, match=r"out\.hdf5 cannot be written: the disk is full"),
        durable.writing(Path("out.hdf5")),
    ):
        raise RuntimeError(text)
    assert "a file cannot be read or written: the disk is full" in str(durable.disk_error(RuntimeError(text)))


@pytest.mark.parametrize(
    ("name", "is_ours"),
    [
        ("a/set", True),
        ("a", True),
        ("a/set/meta/info.json", True),
        ("a/.set.tmp-12/data", True),
        ("a/.set.staged/000000.arrow", True),
        ("a/setting", False),
        ("b/source.parquet", False),
    ],
)
def test_only_faults_of_what_is_written_are_blamed_on_it(name: str, is_ours: bool) -> None:
    error = PermissionError(errno.EACCES, "no", name)
    expected = pytest.raises(DiskError, match=r"set cannot be written: permission denied\. What .* place, then run")
    with expected if is_ours else pytest.raises(PermissionError), durable.writing(Path("a/set")):
        raise error


@pytest.mark.parametrize(
    "error",
    [
        ValueError("a bug"),
        OSError("without a number"),
        KeyError("errno = x"),
        BadInputError("log.h5 cannot be read (errno = 5)"),
    ],
)
def test_other_errors_pass(error: Exception) -> None:
    with pytest.raises(type(error)) as caught, durable.writing(Path("a/set")):
        raise error
    assert caught.value is error and durable.disk_error(error) is None


def test_a_run_is_alone_in_its_folder_or_told_what_to_do(tmp_path: Path) -> None:
    with (
        durable.alone_in(tmp_path),
        pytest.raises(BadInputError, match=f"^{tmp_path} is in use by another run: wait"),
        durable.alone_in(tmp_path),
    ):
        pytest.fail("two are in the folder")
    with durable.alone_in(tmp_path):
        pass


def _file(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("")
    return path


def test_linked_folders_are_entered_and_linked_files_are_files(tmp_path: Path) -> None:
    """Both keep the path by which they were found."""
    _file(tmp_path / "elsewhere/day/log")
    single = _file(tmp_path / "single")
    here = tmp_path / "here"
    here.mkdir()
    (here / "linked").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    (here / "file").symlink_to(single)
    assert durable.files_below(here) == [here / "file", here / "linked/day/log"]


def test_a_folder_with_two_names_is_entered_once(tmp_path: Path) -> None:
    """Its own path counts before a link, whichever is first in the alphabet; of two links the first does."""
    own = _file(tmp_path / "here/own/log")
    (tmp_path / "here/again").symlink_to(own.parent, target_is_directory=True)
    assert durable.files_below(tmp_path / "here") == [own]
    _file(tmp_path / "elsewhere/log")
    for name in ("y", "x"):
        (tmp_path / "here" / name).symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    assert durable.files_below(tmp_path / "here") == [own, tmp_path / "here/x/log"]


def test_a_link_back_up_has_an_end(tmp_path: Path) -> None:
    """Neither to the folder itself nor to one around it."""
    log = _file(tmp_path / "here/day/log")
    _file(tmp_path / "beside")
    (tmp_path / "here/day/self").symlink_to(tmp_path / "here", target_is_directory=True)
    (tmp_path / "here/day/up").symlink_to(tmp_path, target_is_directory=True)
    assert durable.files_below(tmp_path / "here") == [log]


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "log").touch()
    with pytest.raises(DiskError, match=r"set cannot be written: a file is where a folder has to be"):
        durable.write_file(tmp_path / "log/set", "x")


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    target = tmp_path / "set"
    with durable.atomic_folder(target) as path:
        (path / "file").write_text("first")
        assert path.relative_to(tmp_path).parts[0].startswith(".set.tmp-") and not target.exists()
    with pytest.raises(BadInputError, match="exists already"), durable.atomic_folder(target):
        raise AssertionError("refused before anything is written")
    other = tmp_path / "other"
    with pytest.raises(BadInputError, match="exists already"), durable.atomic_folder(other) as path:
        (path / "file").write_text("second")
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
    with pytest.raises(BadInputError, match="set exists already"), durable.atomic_folder(tmp_path / "set"):
        pass
    assert [path.name for path in tmp_path.rglob("*")] == ["set", "theirs"]
