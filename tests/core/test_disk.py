import errno
import os
from pathlib import Path

import pytest

from astra_data.core.durable import disk_error, writing
from astra_data.core.errors import BadInputError, DiskError


@pytest.mark.parametrize(
    ("code", "why", "advice"),
    [
        (errno.ENOSPC, "the disk is full", "free space"),
        (errno.EDQUOT, "the quota is exceeded", "free space"),
        (errno.EFBIG, "a file would be larger than is allowed", "ulimit -f"),
        (errno.EROFS, "the disk is read-only", "make it writable"),
        (errno.EIO, "the disk reports an error", "check it"),
        (errno.ESTALE, "the disk is gone", "connect it again"),
    ],
)
def test_what_the_disk_refuses_is_one_line(code: int, why: str, advice: str) -> None:
    with pytest.raises(DiskError) as caught, writing(Path("a/set")):
        raise OSError(code, os.strerror(code))
    message = str(caught.value)
    assert message.startswith(f"a/set cannot be written: {why}. What was finished before is safe: ")
    assert advice in message
    assert message.endswith(", then run the same command again.")
    assert "\n" not in message


def test_the_fault_that_hdf5_hides_in_its_text_is_found() -> None:
    text = "Can't decrement id ref count (file write failed: time = Mon\n, filename = 'x', errno = 28, error"
    with (
        pytest.raises(DiskError, match=r"out\.hdf5 cannot be written: the disk is full"),
        writing(Path("out.hdf5")),
    ):
        raise RuntimeError(text)
    assert "a file cannot be read or written: the disk is full" in str(disk_error(RuntimeError(text)))


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
    expected = pytest.raises(DiskError, match="set cannot be written: permission is denied")
    with expected if is_ours else pytest.raises(PermissionError), writing(Path("a/set")):
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
    with pytest.raises(type(error)) as caught, writing(Path("a/set")):
        raise error
    assert caught.value is error
    assert disk_error(error) is None


def test_a_lost_connection_is_not_a_fault_of_the_disk() -> None:
    assert disk_error(ConnectionRefusedError(errno.ECONNREFUSED, "refused")) is None
    message = str(disk_error(PermissionError(errno.EACCES, "no", "a/log.csv")))
    assert message.startswith("a/log.csv cannot be read or written: permission is denied.")


def test_a_path_without_a_name_is_told_as_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DiskError, match=r"\. cannot be written: a folder has its name"), writing(Path(".")):
        Path(".").write_bytes(b"")
