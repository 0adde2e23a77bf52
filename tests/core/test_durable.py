import errno
import os
from itertools import count
from pathlib import Path

import pytest
from failing_disk import Killed, failing

from astra_data.core.durable import (
    NO_FSYNC,
    begun_beside,
    clean,
    discard,
    held,
    hidden_folder,
    made_in,
    make_folder,
    sync_tree,
    write_file,
)
from astra_data.core.errors import DiskError

pytestmark = pytest.mark.usefixtures("fsync")
MUTATING = "mkdir rename replace unlink rmdir fsync"


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "er" / "file"
    write_file(path, "first é")
    assert path.read_bytes() == "first é".encode()
    write_file(path, b"\0second")
    assert path.read_bytes() == b"\0second"
    assert names(path.parent) == ["file"]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EROFS])
def test_a_disk_that_fails_at_any_operation_leaves_the_old_file_or_the_new_one(
    tmp_path: Path, code: int
) -> None:
    path = tmp_path / "file"
    for at in count():
        write_file(path, "old")
        with failing(MUTATING, at, OSError(code, os.strerror(code))) as calls:
            try:
                write_file(path, "new")
            except DiskError as error:
                assert f"{path} cannot be written: " in str(error)
                assert path.read_text() in ("old", "new")
            else:
                assert path.read_text() == "new"
        if len(calls) <= at:
            break
    assert at > 5
    write_file(path, "last")
    assert names(tmp_path) == ["file"]


def test_a_kill_at_any_operation_leaves_the_old_file_or_the_new_one(tmp_path: Path) -> None:
    path = tmp_path / "file"
    for at in count():
        write_file(path, "old")
        with failing(MUTATING, at, Killed(), Killed()) as calls:
            try:
                write_file(path, "new")
            except Killed:
                assert path.read_text() in ("old", "new")
        if len(calls) <= at:
            break
    write_file(path, "last")
    assert names(tmp_path) == ["file"]


def test_what_is_no_plain_file_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    fifo = tmp_path / "pipe"
    os.mkfifo(fifo)
    reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    write_file(fifo, "through")
    assert os.read(reader, 100) == b"through"
    os.close(reader)
    assert fifo.is_fifo()
    (tmp_path / "folder").mkdir()
    with pytest.raises(DiskError, match="a folder has its name"):
        write_file(tmp_path / "folder", "text")


def test_the_disk_has_each_file_before_its_name_and_each_name_before_the_end(
    tmp_path: Path, disk_order: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_file(tmp_path / "new" / "file", "text")
    assert disk_order == [f"fsync {tmp_path.name}", "fsync file", "replace", "fsync new"]
    disk_order.clear()
    make_folder(tmp_path / "a" / "b")
    assert sorted(disk_order) == sorted([f"fsync {tmp_path.name}", "fsync a"])
    disk_order.clear()
    sync_tree(tmp_path / "new")
    assert sorted(disk_order) == ["fsync file", "fsync new"]
    monkeypatch.setenv(NO_FSYNC, "1")
    disk_order.clear()
    write_file(tmp_path / "file", "text")
    assert disk_order == ["replace"]


def test_a_folder_is_whole_or_gone_whenever_its_removal_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / ".set.staged"
    for at in count():
        (folder / "deep").mkdir(parents=True)
        for name in ("plan", "deep/1", "deep/2"):
            (folder / name).touch()
        with failing(MUTATING, at, Killed(), Killed()) as calls:
            try:
                discard(folder, tmp_path / "set")
            except Killed:
                if folder.exists():
                    assert sorted(path.name for path in folder.rglob("*")) == ["1", "2", "deep", "plan"]
        if len(calls) <= at:
            break
        if folder.exists():
            discard(folder, tmp_path / "set")
    assert at > 5
    assert [state for _, state in clean(tmp_path)] == ["removed"] * len(names(tmp_path)) or not names(
        tmp_path
    )
    assert names(tmp_path) == []


def test_a_failure_removes_the_folders_that_were_made_for_it_alone(tmp_path: Path) -> None:
    home = tmp_path / "home"
    with pytest.raises(KeyError), hidden_folder(home / "of/walks/data-1.0.0"):
        raise KeyError
    assert not home.exists()
    with pytest.raises(DiskError):
        write_file(home / ("walks" * 100) / "notes.txt", "its name is too long")
    assert not home.exists()
    home.mkdir()
    with pytest.raises(KeyError), hidden_folder(home / "walks/data-1.0.0"):
        raise KeyError
    assert home.is_dir() and not list(home.iterdir())
    with pytest.raises(KeyError), hidden_folder(home / "walks/data-1.0.0"):
        write_file(home / "walks/notes.txt", "of somebody else")
        raise KeyError
    assert [path.name for path in (home / "walks").iterdir()] == ["notes.txt"]


def test_a_folder_that_another_process_removed_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "walks/data-1.0.0"
    monkeypatch.setattr("astra_data.core.durable.sweep", lambda target: target.parent.rmdir())
    with hidden_folder(place) as folder:
        assert folder.parent == place.parent


def test_what_a_command_goes_on_with_is_beside_its_target(tmp_path: Path) -> None:
    for name in (
        ".set.staged",
        ".set.partial",
        ".set.tmp-12",
        ".set.old",
        ".set2.partial",
        "set",
        "set.partial",
    ):
        (tmp_path / name).mkdir()
    assert begun_beside(tmp_path / "set") == [tmp_path / ".set.partial", tmp_path / ".set.staged"]
    assert begun_beside(tmp_path / "none") == []


@pytest.mark.parametrize(
    ("holds", "made"),
    [
        ([], []),
        (["a/", "b/c/"], []),
        (["b/.seed_0.partial/policy", "a/.seed_1.staged/x/y"], ["a/.seed_1.staged", "b/.seed_0.partial"]),
        (["a/.seed_0.partial/seed_0/x", "a/.seed_0.tmp-12/x", "a/.x.json.tmp-12"], ["a/.seed_0.partial"]),
        (["a/.seed_0.partial/x", "a/file"], ["."]),
        (["a/.seed_0.partial/x", "a/.seed_0.old/x"], ["."]),
        (["a/.seed_0.partial/x", "b/seed_0/"], ["."]),
    ],
)
def test_a_folder_of_nothing_but_begun_work_holds_that_alone(
    holds: list[str], made: list[str], tmp_path: Path
) -> None:
    for name in holds:
        place = tmp_path / name
        (place if name.endswith("/") else place.parent).mkdir(parents=True, exist_ok=True)
        if not name.endswith("/"):
            place.touch()
    assert made_in(tmp_path, "seed_*") == [tmp_path / name for name in made]


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
    with held(alive):
        found = dict(clean(home))
    assert found == {
        dead: "removed",
        alive: "in use",
        staged: "kept",
        home / ".out.hdf5.tmp-99": "removed",
        home / ".pipe.tmp-98": "removed",
    }
    assert names(home) == [
        ".git",
        ".notes.partial",
        ".set.staged",
        ".set.tmp-13-1",
        "ant",
        "file",
        "set.tmp-1",
    ]
    assert names(home / "ant") == []
    assert clean(tmp_path / "none") == []


def test_what_a_kill_left_beside_a_name_with_brackets_is_removed(tmp_path: Path) -> None:
    (tmp_path / ".walks[1].json.tmp-7").mkdir()
    write_file(tmp_path / "walks[1].json", "{}")
    assert names(tmp_path) == ["walks[1].json"]


def test_ctrl_c_removes_the_folders_that_were_made(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), hidden_folder(tmp_path / "home/walks/data-1.0.0"):
        raise KeyboardInterrupt
    assert names(tmp_path) == []


def test_pipes_among_files_are_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    sync_tree(tmp_path)
