import errno
import hashlib
import json
import os
from itertools import count
from pathlib import Path

import pytest
import torch
from failing_disk import failing

from astra_data.core.artifact import CHECKPOINT, MANIFEST, finished_folder, read_manifest, write_manifest
from astra_data.core.checkpoint import save_tensors
from astra_data.core.errors import BadInputError, DiskError


def test_a_finished_folder_says_what_it_was_made_from_and_has_no_checkpoints(tmp_path: Path) -> None:
    out = tmp_path / "train/out"
    with finished_folder(out, made_from={"dataset": "d1", "initial": None}) as folder:
        for name in ("weights", CHECKPOINT, f"adaptation_{CHECKPOINT}"):
            (folder / name).touch()
        assert folder == tmp_path / "train/.out.partial" and not out.exists() and not read_manifest(folder)
    manifest = read_manifest(out)
    assert manifest is not None and manifest.made_from == {"dataset": "d1"}
    assert manifest.files.keys() == {"weights"} and not folder.exists()
    assert {path.name for path in out.iterdir()} == {"weights", MANIFEST}


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
    with pytest.raises(type(error)), finished_folder(tmp_path / "train" / "astra" / "seed_0", config=config):
        raise error
    assert [path.name for path in tmp_path.rglob("*")] == ["train"]


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


def test_a_finished_folder_is_replaced_only_on_request_and_after_success(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").touch()
    with pytest.raises(BadInputError, match="already finished"), finished_folder(tmp_path / "out"):
        pass
    with pytest.raises(KeyboardInterrupt), finished_folder(tmp_path / "out", replace=True) as folder:
        (folder / "half").touch()
        raise KeyboardInterrupt
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["old"]
    with finished_folder(tmp_path / "out", replace=True) as folder:
        (folder / "new").touch()
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == ["out", "out/new"]


@pytest.mark.parametrize("renames", [0, 1, 2])
def test_a_kill_while_replacing_loses_nothing(tmp_path: Path, renames: int, monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == ["out", "out/newer"]


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


def test_what_a_kill_left_in_the_working_folder_is_not_published(tmp_path: Path) -> None:
    partial = tmp_path / ".out.partial"
    (partial / ".checkpoint.pt.tmp-7").mkdir(parents=True)
    (partial / ".model.safetensors.tmp-8").touch()
    with finished_folder(tmp_path / "out", config="1") as folder:
        (folder / "model").touch()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["config.json", "model"]


@pytest.mark.usefixtures("fsync")
def test_the_disk_has_what_a_folder_holds_before_its_name(tmp_path: Path, disk_order: list[str]) -> None:
    with finished_folder(tmp_path / "out") as folder:
        (folder / "model").write_text("weights")
        disk_order.clear()
    assert sorted(disk_order[: disk_order.index("replace")]) == ["fsync .out.partial", "fsync model"]


def test_a_manifest_holds_sizes_and_sums_by_which_damage_is_found(tmp_path: Path) -> None:
    (tmp_path / "plots").mkdir()
    (tmp_path / "weights").write_bytes(b"abc")
    (tmp_path / "plots/one.png").write_bytes(b"")
    write_manifest(tmp_path, {"dataset": "d1", "grounding": None})
    assert json.loads((tmp_path / MANIFEST).read_text()) == {
        "files": {
            "plots/one.png": {"bytes": 0, "sha256": hashlib.sha256(b"").hexdigest()},
            "weights": {"bytes": 3, "sha256": hashlib.sha256(b"abc").hexdigest()},
        },
        "made_from": {"dataset": "d1"},
    }
    manifest = read_manifest(tmp_path)
    assert manifest is not None and manifest.faults(tmp_path, verify=True) == []
    (tmp_path / "weights").write_bytes(b"abd")
    assert manifest.faults(tmp_path, verify=False) == []
    assert manifest.faults(tmp_path, verify=True) == ["weights was altered"]
    (tmp_path / "weights").write_bytes(b"")
    (tmp_path / "plots/one.png").unlink()
    faults = ["plots/one.png is missing", "weights has 0 bytes, expected 3"]
    assert manifest.faults(tmp_path, verify=False) == manifest.faults(tmp_path, verify=True) == faults


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"files": {"a": 3}, "made_from": {}}', "\udcff"])
def test_a_manifest_that_cannot_be_read_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / MANIFEST).write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(BadInputError, match=r"^manifest\.json cannot be read"):
        read_manifest(tmp_path)
