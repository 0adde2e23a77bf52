import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

import pytest
import torch
from failing_disk import failing

from astra_data.core.artifact import CHECKPOINT, MANIFEST, finished_folder, read_manifest
from astra_data.core.checkpoint import save_tensors
from astra_data.core.errors import BadInputError, DiskError


def test_a_folder_appears_when_it_is_finished(tmp_path: Path) -> None:
    out = tmp_path / "train" / "seed_0"
    with finished_folder(out) as folder:
        (folder / "a").touch()
        assert not out.exists()
        assert folder == tmp_path / "train" / ".seed_0.partial"
    assert [path.name for path in out.iterdir()] == ["a"]
    assert not folder.exists()


def test_a_finished_folder_says_what_it_was_made_from_and_has_no_checkpoints(tmp_path: Path) -> None:
    with finished_folder(tmp_path / "out", made_from={"dataset": "d1", "initial": None}) as folder:
        for name in ("weights", CHECKPOINT, f"adaptation_{CHECKPOINT}"):
            (folder / name).touch()
    manifest = read_manifest(tmp_path / "out")
    assert manifest is not None and manifest.made_from == {"dataset": "d1"}
    assert manifest.files.keys() == {"weights"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"weights", MANIFEST}


def test_an_interrupted_folder_is_found_again(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), finished_folder(tmp_path / "out") as folder:
        (folder / "checkpoint").touch()
        raise KeyboardInterrupt
    assert not (tmp_path / "out").exists()
    with finished_folder(tmp_path / "out") as folder:
        assert (folder / "checkpoint").exists()


def test_a_folder_begun_with_another_config_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt), finished_folder(out, config="1") as folder:
        (folder / "checkpoint").touch()
        raise KeyboardInterrupt
    with (
        pytest.raises(BadInputError, match=f"{folder} was started with other settings"),
        finished_folder(out, config="2"),
    ):
        pass
    with finished_folder(out, config="1"):
        pass
    made = sorted((path.name, path.read_text()) for path in out.iterdir())
    assert made == [("checkpoint", ""), ("config.json", "1")]


@pytest.mark.parametrize("config", [None, "1"])
@pytest.mark.parametrize("error", [BadInputError("no episodes"), KeyboardInterrupt()])
def test_a_failure_before_anything_is_made_leaves_nothing(
    tmp_path: Path, config: str | None, error: BaseException
) -> None:
    (tmp_path / "train").mkdir()
    with (
        pytest.raises(type(error)),
        finished_folder(tmp_path / "train" / "astra" / "seed_0", config=config),
    ):
        raise error
    assert [path.name for path in tmp_path.rglob("*")] == ["train"]


def test_what_was_only_begun_with_other_settings_is_begun_anew(tmp_path: Path) -> None:
    (tmp_path / ".out.partial").mkdir()
    (tmp_path / ".out.partial/config.json").write_text("1")
    with finished_folder(tmp_path / "out", config="2"):
        pass
    assert (tmp_path / "out/config.json").read_text() == "2"


@pytest.mark.parametrize("replace", [False, True])
def test_what_another_is_making_is_left_to_it(tmp_path: Path, replace: bool) -> None:
    out = tmp_path / "out"
    with finished_folder(out, config="1") as folder:
        (folder / "model").touch()
        with (
            pytest.raises(BadInputError, match="out is being written right now: wait"),
            finished_folder(out, replace=replace, config="1"),
        ):
            pytest.fail("it was yielded twice")
    assert sorted(path.name for path in out.iterdir()) == ["config.json", "model"]


def test_what_another_finished_while_the_lock_was_awaited_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder that it locks may be the other's, which by then has its name."""
    out = tmp_path / "out"

    @contextmanager
    def late(folder: Path) -> Iterator[bool]:
        (folder / "model").touch()
        folder.rename(out)
        yield True

    monkeypatch.setattr("astra_data.core.artifact.held", late)
    with pytest.raises(BadInputError, match="already finished"), finished_folder(out):
        pytest.fail("it was made again")
    assert [path.name for path in out.iterdir()] == ["model"]


def test_a_folder_without_a_name_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadInputError, match="already finished"), finished_folder(Path(".")):
        pass
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_gone_hides_no_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="the true error"), finished_folder(tmp_path / "out") as folder:
        folder.rmdir()
        raise ValueError("the true error")


def test_a_folder_begun_without_a_config_is_refused(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), finished_folder(tmp_path / "out") as folder:
        (folder / "checkpoint").touch()
        raise KeyboardInterrupt
    with (
        pytest.raises(BadInputError, match="started with other"),
        finished_folder(tmp_path / "out", config="1"),
    ):
        pass
    assert [path.name for path in folder.iterdir()] == ["checkpoint"]


def test_a_finished_folder_is_replaced_only_on_request(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").touch()
    with pytest.raises(BadInputError, match="already finished"), finished_folder(tmp_path / "out"):
        pass
    with finished_folder(tmp_path / "out", replace=True) as folder:
        (folder / "new").touch()
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == [
        "out",
        "out/new",
    ]


def test_a_failed_replacement_leaves_the_old_folder_and_is_not_gone_on_with(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").touch()
    with pytest.raises(KeyboardInterrupt), finished_folder(tmp_path / "out", replace=True) as folder:
        (folder / "half").touch()
        raise KeyboardInterrupt
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["old"]
    with finished_folder(tmp_path / "out", replace=True) as folder:
        assert not list(folder.iterdir())


@pytest.mark.parametrize("renames", [0, 1, 2])
def test_a_kill_while_replacing_loses_nothing(
    tmp_path: Path, renames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, left = tmp_path / "out", [renames]

    def replace_until_killed(source: Path, target: Path) -> None:
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        source.rename(target)

    def killed(_: Path) -> None:
        raise KeyboardInterrupt

    out.mkdir()
    (out / "old").touch()
    with monkeypatch.context() as patched:
        patched.setattr("os.replace", replace_until_killed)
        patched.setattr("shutil.rmtree", killed)
        with pytest.raises(KeyboardInterrupt), finished_folder(out, replace=True) as folder:
            (folder / "new").touch()
    with pytest.raises(BadInputError, match="already finished"), finished_folder(out):
        pass
    assert [path.name for path in out.iterdir()] == ["new" if renames == 2 else "old"]
    with finished_folder(out, replace=True) as folder:
        (folder / "newer").touch()
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == [
        "out",
        "out/newer",
    ]


@pytest.mark.usefixtures("fsync")
def test_a_disk_that_fails_at_any_operation_leaves_a_folder_to_go_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda handle: None)

    def make(out: Path) -> None:
        with finished_folder(out, config="1") as folder:
            save_tensors(folder / "model.safetensors", {"weight": torch.ones(2)}, {})

    make(tmp_path / "whole")
    whole = {path.name: path.read_bytes() for path in (tmp_path / "whole").iterdir()}
    for at in count():
        out = tmp_path / f"at_{at}" / "out"
        with failing("mkdir rename replace unlink rmdir fsync", at, OSError(errno.ENOSPC, "")) as calls:
            try:
                make(out)
            except DiskError as error:
                assert "cannot be written: the disk is full" in str(error)
        if not out.exists():
            make(out)
        assert {path.name: path.read_bytes() for path in out.iterdir()} == whole
        if len(calls) <= at:
            break
    assert at > 15


def test_a_disk_that_fails_while_a_folder_is_replaced_leaves_the_old_one_or_the_new_one(
    tmp_path: Path,
) -> None:
    out = tmp_path / "out"
    (out / "first").mkdir(parents=True)
    for at in count():
        with (
            failing("rename replace", at, OSError(errno.EIO, "fault")) as calls,
            suppress(DiskError),
            finished_folder(out, replace=True) as folder,
        ):
            (folder / f"{at}").touch()
        assert len(list(out.iterdir())) == 1
        if len(calls) <= at:
            break
    assert [path.name for path in out.iterdir()] == [str(at)]
    assert at > 1


def test_what_a_kill_left_in_the_working_folder_is_not_published(tmp_path: Path) -> None:
    partial = tmp_path / ".out.partial"
    (partial / ".checkpoint.safetensors.tmp-7").mkdir(parents=True)
    (partial / ".model.safetensors.tmp-8").touch()
    with finished_folder(tmp_path / "out", config="1") as folder:
        (folder / "model").touch()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["config.json", "model"]


@pytest.mark.usefixtures("fsync")
def test_the_disk_has_what_a_folder_holds_before_its_name(tmp_path: Path, disk_order: list[str]) -> None:
    with finished_folder(tmp_path / "out") as folder:
        (folder / "model").write_text("weights")
        disk_order.clear()
    before = disk_order[: disk_order.index("replace")]
    assert sorted(before) == ["fsync .out.partial", "fsync model"]


def test_a_linked_folder_in_what_is_replaced_is_unlinked_alone(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data/file").touch()
    (tmp_path / ".out.partial").mkdir()
    (tmp_path / ".out.partial/link").symlink_to(tmp_path / "data")
    with finished_folder(tmp_path / "out", replace=True) as folder:
        assert not list(folder.iterdir())
    assert (tmp_path / "data/file").exists()
