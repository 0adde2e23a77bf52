"""Pulls that are interrupted, and places that are not to be trusted."""

import fcntl
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from fake_dataset import write_fake
from shared_files import contents

from astra_data.core.errors import BadInputError, CorruptDatasetError, SharingError
from astra_data.dataset.reader import Dataset
from astra_data.io.hub import fetch
from astra_data.io.hub.pull import pull
from astra_data.io.hub.push import push
from astra_data.io.hub.store import RemoteFolder

pytestmark = pytest.mark.usefixtures("quick_figure")

DATA = "data/chunk-000/file-000.parquet"


@pytest.fixture
def shared(fake: Dataset, tmp_path: Path) -> Path:
    """Where the fake dataset was pushed to: the folder of its version."""
    push(fake.root, f"file://{tmp_path}/shared")
    return tmp_path / "shared/fake/data-1.0.0"


def source(shared: Path) -> str:
    return f"file://{shared.parent}"


def resign(shared: Path) -> None:
    """Make SHA256SUMS agree with the files, as one who wishes harm would."""
    files = {
        path: content for path, content in contents(shared).items() if path.startswith(("data/", "meta/"))
    }
    lines = [f"{hashlib.sha256(content).hexdigest()}  {path}\n" for path, content in files.items()]
    lines += [f"# {len(content)} bytes  {path}\n" for path, content in files.items()]
    (shared / "SHA256SUMS").write_text("".join(lines))


def hidden(out: Path) -> list[str]:
    return [path.name for path in out.parent.iterdir() if path.name.startswith(f".{out.name}")]


def test_a_pull_goes_on_where_it_stopped(
    fake: Dataset, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    partial = tmp_path / ".out.pull-1.0.0"
    for path, size in ((DATA, 1000), ("meta/info.json", None)):
        (partial / path).parent.mkdir(parents=True, exist_ok=True)
        name = path if size is None else f"{path}.part"
        (partial / name).write_bytes((fake.root / path).read_bytes()[:size])
    (partial / "data/stranger").touch()
    fetched: list[tuple[str, int]] = []
    append = fetch._append

    def watched(remote: object, path: str, part: Path, most: int) -> None:
        before = part.stat().st_size if part.exists() else 0
        append(remote, path, part, most)  # type: ignore[arg-type]
        fetched.append((path, part.stat().st_size - before))

    monkeypatch.setattr(fetch, "_append", watched)
    pulled = pull(source(shared), out=tmp_path / "out")
    assert contents(pulled.root) == contents(fake.root)
    assert "meta/info.json" not in dict(fetched)
    assert dict(fetched)[DATA] == (fake.root / DATA).stat().st_size - 1000
    assert not hidden(tmp_path / "out")


@pytest.mark.parametrize("left", [b"x" * 1000, b"x" * 10**6])
def test_what_was_left_of_other_files_is_fetched_again(
    left: bytes, fake: Dataset, shared: Path, tmp_path: Path
) -> None:
    folder = tmp_path / ".out.pull-1.0.0/data/chunk-000"
    folder.mkdir(parents=True)
    (folder / "file-000.parquet.part").write_bytes(left)
    (folder / "file-000.parquet").write_bytes(left)
    assert contents(pull(source(shared), out=tmp_path / "out").root) == contents(fake.root)


def test_killed_at_any_moment_a_pull_leaves_nothing_unreadable(
    fake: Dataset, shared: Path, tmp_path: Path
) -> None:
    script = Path(__file__).parents[2] / "killed_pulls.py"
    command = [sys.executable, str(script), source(shared), str(tmp_path / "out"), str(fake.root), "6"]
    told = subprocess.run(command, capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    assert told.stdout.splitlines()[-1] == "whole"


def test_a_folder_here_is_not_looked_for_on_the_hub(
    shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine/fake").mkdir(parents=True)
    for source in ("mine/fake", "mine/fake@data-1.0.0"):
        with pytest.raises(BadInputError, match=rf"^{source} is a folder here: pull ./{source}, or hf://"):
            pull(source)


def test_what_is_there_already_is_left_alone(fake: Dataset, shared: Path, tmp_path: Path) -> None:
    first = pull(source(shared), out=tmp_path / "out")
    (shared / DATA).unlink()
    assert pull(source(shared), out=tmp_path / "out").content_hash == first.content_hash
    write_fake(tmp_path / "other", fps=10)
    (tmp_path / "file").touch()
    for out in (tmp_path / "other", tmp_path, tmp_path / "file"):
        with pytest.raises(BadInputError, match="exists already and holds something else"):
            pull(source(shared), out=out)


def test_a_folder_of_which_no_file_is_of_the_dataset_holds_something_else(
    shared: Path, tmp_path: Path
) -> None:
    copy = pull(source(shared), out=tmp_path / "out").root
    for path in contents(copy):
        (copy / path).write_bytes(b"{}")
    with pytest.raises(BadInputError, match="exists already and holds something else"):
        pull(source(shared), out=copy)


def test_a_copy_that_was_altered_is_told(fake: Dataset, shared: Path, tmp_path: Path) -> None:
    copy = pull(source(shared), out=tmp_path / "out").root
    for path in (DATA, "meta/stats.json"):
        whole = (copy / path).read_bytes()
        # A changed byte, and a file that is shorter: of a data file, it can then not even be opened.
        for content in (bytes([whole[100] ^ 1]).join([whole[:100], whole[101:]]), whole[:-20]):
            (copy / path).write_bytes(content)
            with pytest.raises(
                CorruptDatasetError, match=r"was altered: .*Delete it, or pull to another"
            ) as caught:
                pull(source(shared), out=copy)
            assert ".." not in str(caught.value), "two messages in one"
        (copy / path).write_bytes(whole)
    notes: list[str] = []
    pull(source(shared), out=copy, progress=lambda fraction, note: notes.append(note))
    assert notes == [f"it is there already, and whole: {len(contents(fake.root))} files were compared"]


def test_a_file_that_is_no_part_of_the_format_fetches_nothing(shared: Path, tmp_path: Path) -> None:
    (shared / "data/evil.sh").write_text("echo evil")
    digest = hashlib.sha256(b"echo evil").hexdigest()
    with (shared / "SHA256SUMS").open("a") as sums:
        sums.write(f"{digest}  data/evil.sh\n")
    with pytest.raises(SharingError, match=r"data/evil\.sh', expected one of a dataset's files"):
        pull(source(shared), out=tmp_path / "out")
    assert not hidden(tmp_path / "out")


@pytest.mark.parametrize("path", [DATA, "SHA256SUMS", "meta/astra/dataset.json"])
@pytest.mark.parametrize("target", ["/dev/zero", "pipe", "copy"])
def test_links_devices_and_pipes_are_not_read(path: str, target: str, shared: Path, tmp_path: Path) -> None:
    (shared / path).rename(tmp_path / "copy")
    if target == "pipe":
        os.mkfifo(shared / path)
    else:
        (shared / path).symlink_to(tmp_path / target)
    with pytest.raises(SharingError, match=f"{path} is a link, a device or a pipe"):
        pull(source(shared), out=tmp_path / "out")
    assert not hidden(tmp_path / "out")


def test_a_folder_that_is_a_link_is_not_read(shared: Path, tmp_path: Path) -> None:
    (shared / "data").rename(tmp_path / "data")
    (shared / "data").symlink_to(tmp_path / "data")
    with pytest.raises(SharingError, match="data is a link"):
        pull(source(shared), out=tmp_path / "out")


def test_more_bytes_than_asked_for_are_refused_before_anything_is_fetched(
    shared: Path, tmp_path: Path
) -> None:
    size = sum(len(content) for path, content in contents(shared).items() if "README" not in path)
    size -= (shared / "SHA256SUMS").stat().st_size
    with pytest.raises(SharingError, match=rf"has {size} bytes, of which at most {size - 1} .*--max-bytes"):
        pull(source(shared), out=tmp_path / "out", max_bytes=size - 1)
    assert not hidden(tmp_path / "out")
    pull(source(shared), out=tmp_path / "out", max_bytes=size)


def test_files_of_sizes_that_no_store_tells_are_bounded_all_together(
    shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = sum(
        len(content) for path, content in contents(shared).items() if path.startswith(("data", "meta"))
    )
    files = RemoteFolder.files
    monkeypatch.setattr(RemoteFolder, "files", lambda self: {path: {} for path in files(self)})
    with pytest.raises(SharingError, match=f"has {size} bytes, of which at most {size - 1} are taken"):
        pull(source(shared), out=tmp_path / "out", max_bytes=size - 1)
    assert not (tmp_path / "out").exists()
    pull(source(shared), out=tmp_path / "out", max_bytes=size)


def test_a_file_that_grew_is_refused_before_anything_is_fetched(shared: Path, tmp_path: Path) -> None:
    with (shared / DATA).open("ab") as file:
        file.truncate(2**40)
    with pytest.raises(SharingError, match=f"was altered: {DATA} has {2**40} bytes"):
        pull(source(shared), out=tmp_path / "out")
    assert not hidden(tmp_path / "out")


def test_a_link_planted_in_the_unfinished_folder_is_refused(shared: Path, tmp_path: Path) -> None:
    (tmp_path / "prey").write_text("prey")
    folder = tmp_path / ".out.pull-1.0.0/data/chunk-000"
    folder.mkdir(parents=True)
    (folder / "file-000.parquet.part").symlink_to(tmp_path / "prey")
    with pytest.raises(SharingError, match=r"file-000\.parquet\.part is a link"):
        pull(source(shared), out=tmp_path / "out")
    assert (tmp_path / "prey").read_text() == "prey"


def test_two_pulls_of_one_dataset_do_not_mix(shared: Path, tmp_path: Path) -> None:
    (tmp_path / ".out.pull-1.0.0").mkdir()
    handle = os.open(tmp_path / ".out.pull-1.0.0", os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    with pytest.raises(BadInputError, match="being pulled right now"):
        pull(source(shared), out=tmp_path / "out")
    os.close(handle)
    pull(source(shared), out=tmp_path / "out")


def test_a_folder_that_cannot_be_made_is_told(shared: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(BadInputError, match="cannot be written"):
        pull(source(shared), out=tmp_path / "file/out")


def test_a_damaged_file_is_told_and_not_kept(fake: Dataset, shared: Path, tmp_path: Path) -> None:
    whole = (shared / DATA).read_bytes()
    (shared / DATA).write_bytes(whole[:-1] + b"?")
    with pytest.raises(SharingError, match=f"{DATA} does not have the sha256"):
        pull(source(shared), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (shared / DATA).write_bytes(whole)
    assert contents(pull(source(shared), out=tmp_path / "out").root) == contents(fake.root)


def test_a_missing_file_is_told(shared: Path, tmp_path: Path) -> None:
    (shared / DATA).unlink()
    with pytest.raises(SharingError, match=f"{DATA} cannot be downloaded .*run the same command again"):
        pull(source(shared), out=tmp_path / "out")


def test_a_listing_that_leads_out_of_the_folder_fetches_nothing(shared: Path, tmp_path: Path) -> None:
    (tmp_path / "shared/fake/prey").write_text("prey")
    digest = hashlib.sha256(b"prey").hexdigest()
    sums = (shared / "SHA256SUMS").read_text()
    for path in ("data/../../prey", "/etc/passwd", "../prey"):
        (shared / "SHA256SUMS").write_text(f"{sums}{digest}  {path}\n")
        with pytest.raises(SharingError, match=r"cannot be trusted.*Nothing was downloaded"):
            pull(source(shared), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert not hidden(tmp_path / "out")


@pytest.mark.parametrize(
    ("key", "value"), [("name", "../../away"), ("name", ".."), ("name", 3), ("version", "9.0.0")]
)
def test_a_description_cannot_choose_its_place(key: str, value: object, shared: Path, home: Path) -> None:
    description = json.loads((shared / "meta/astra/dataset.json").read_text()) | {key: value}
    (shared / "meta/astra/dataset.json").write_text(json.dumps(description))
    resign(shared)
    with pytest.raises(SharingError, match="calls itself"):
        pull(source(shared))
    assert not home.exists()


@pytest.mark.parametrize(
    ("path", "change"),
    [
        ("meta/info.json", {"data_path": "/etc/passwd"}),
        ("meta/info.json", {"data_path": "../../shared/fake/data-1.0.0/data/chunk-000/file-000.parquet"}),
        ("meta/info.json", {"features": 3}),
        ("meta/info.json", {"total_frames": 3}),
        ("meta/astra/subsets.json", {"uids": [[]]}),
        ("meta/astra/dataset.json", {"content_hash": "0" * 64}),
    ],
)
def test_what_is_no_whole_dataset_is_refused(
    path: str, change: dict[str, object], shared: Path, tmp_path: Path
) -> None:
    content = json.loads((shared / path).read_text()) | change
    (shared / path).write_text(json.dumps(content))
    resign(shared)
    with pytest.raises(SharingError, match="is not a complete dataset"):
        pull(source(shared), out=tmp_path / "new/place/out")
    assert not (tmp_path / "new").exists()
