"""Pulls that are interrupted, and places that are not to be trusted."""

import errno
import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import fsspec
import pytest
from damaged import DATA, edit
from fake_dataset import DESCRIPTION, write_fake
from fsspec.implementations.local import LocalFileSystem
from shared_files import contents

from astra_data.core.errors import BadInputError, CorruptDatasetError, DiskError, RecipeError, SharingError
from astra_data.dataset.reader import Dataset
from astra_data.io.hub import sharing
from astra_data.io.hub.sharing import pull, push
from astra_data.io.hub.stores import RemoteFolder, UrlStore

pytestmark = pytest.mark.usefixtures("quick_figure")

DESCRIBED = "meta/astra/dataset.json"


@pytest.fixture
def shared(fake: Dataset, tmp_path: Path) -> Path:
    """Where the fake dataset was pushed to: the folder of its version."""
    push(fake.root, f"file://{tmp_path}/shared")
    return tmp_path / "shared/fake/data-1.0.0"


def source(shared: Path) -> str:
    return f"file://{shared.parent}"


def resign(shared: Path) -> None:
    """Make SHA256SUMS agree with the files, as one who wishes harm would."""
    files = {path: content for path, content in contents(shared).items() if path.startswith(("data/", "meta/"))}
    lines = [f"{hashlib.sha256(content).hexdigest()}  {path}\n" for path, content in files.items()]
    (shared / "SHA256SUMS").write_text("".join(lines))


def hidden(out: Path) -> list[str]:
    return [path.name for path in out.parent.iterdir() if path.name.startswith(f".{out.name}")]


def test_killed_at_any_moment_a_pull_leaves_nothing_unreadable(fake: Dataset, shared: Path, tmp_path: Path) -> None:
    script = Path(__file__).parents[2] / "killed_pulls.py"
    command = [sys.executable, str(script), source(shared), str(tmp_path / "out"), str(fake.root), "4"]
    told = subprocess.run(command, capture_output=True, text=True)
    assert told.returncode == 0, told.stderr
    assert told.stdout.splitlines()[-1] == "whole"


def test_a_folder_here_is_not_looked_for_on_the_hub(
    fake: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine/fake").mkdir(parents=True)
    for source in ("mine/fake", "mine/fake@data-1.0.0"):
        with pytest.raises(BadInputError, match=rf"^{source} is a folder here: pull ./{source}, or hf://"):
            pull(source)
    with pytest.raises(BadInputError, match=r"^mine/fake is a folder here: push to \./mine/fake, or hf://"):
        push(fake.root, "mine/fake")


def test_what_is_there_already_is_left_alone(fake: Dataset, shared: Path, tmp_path: Path) -> None:
    first = pull(source(shared), out=tmp_path / "out")
    (shared / DATA).unlink()
    assert pull(source(shared), out=tmp_path / "out").content_hash == first.content_hash
    write_fake(tmp_path / "other", fps=10)
    write_fake(tmp_path / "named", description={**DESCRIPTION, "name": "namesake"})
    (tmp_path / "file").touch()
    plain = shutil.copytree(first.root, tmp_path / "plain", ignore=shutil.ignore_patterns("astra"))
    for out in (tmp_path / "other", tmp_path / "named", plain, tmp_path, tmp_path / "file"):
        with pytest.raises(BadInputError, match="exists already and holds something else"):
            pull(source(shared), out=out)
    with pytest.raises(DiskError, match="set cannot be written: a file is where a folder has to be"):
        pull(source(shared), out=tmp_path / "file" / "set")


def test_a_copy_that_was_altered_is_told(fake: Dataset, shared: Path, tmp_path: Path) -> None:
    copy = pull(source(shared), out=tmp_path / "out").root
    for path in (DATA, "meta/stats.json"):
        whole = (copy / path).read_bytes()
        # A changed byte, and a file that is shorter: of a data file, it can then not even be opened.
        for content in (bytes([whole[100] ^ 1]).join([whole[:100], whole[101:]]), whole[:-20]):
            (copy / path).write_bytes(content)
            with pytest.raises(CorruptDatasetError, match=r"was altered: .*Delete it, or pull to another") as caught:
                pull(source(shared), out=copy)
            assert ".." not in str(caught.value), "two messages in one"
        (copy / path).write_bytes(whole)
    notes: list[str] = []
    pull(source(shared), out=copy, progress=lambda fraction, note: notes.append(note))
    assert notes == [f"it is there already, and whole: {len(contents(fake.root))} files were compared"]


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
    with pytest.raises(SharingError, match="is a link, a device or a pipe"):
        pull(source(shared), out=tmp_path / "out")


def test_more_bytes_than_asked_for_are_refused_before_anything_is_fetched(shared: Path, tmp_path: Path) -> None:
    size = sum(len(content) for path, content in contents(shared).items() if "README" not in path)
    size -= (shared / "SHA256SUMS").stat().st_size
    with pytest.raises(SharingError, match=rf"has {size} bytes, of which at most {size - 1} .*--max-bytes"):
        pull(source(shared), out=tmp_path / "out", max_bytes=size - 1)
    assert not hidden(tmp_path / "out")
    pull(source(shared), out=tmp_path / "out", max_bytes=size)


def test_two_pulls_of_one_dataset_do_not_mix(shared: Path, tmp_path: Path) -> None:
    (tmp_path / ".out.pull-1.0.0").mkdir()
    handle = os.open(tmp_path / ".out.pull-1.0.0", os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    with pytest.raises(BadInputError, match="being pulled right now"):
        pull(source(shared), out=tmp_path / "out")
    os.close(handle)
    pull(source(shared), out=tmp_path / "out")


def test_a_damaged_file_is_told_and_not_kept(fake: Dataset, shared: Path, tmp_path: Path) -> None:
    whole = (shared / DATA).read_bytes()
    (shared / DATA).write_bytes(whole[:-1] + b"?")
    with pytest.raises(SharingError, match=f"{DATA} do not have the sha256"):
        pull(source(shared), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (shared / DATA).write_bytes(whole)
    assert contents(pull(source(shared), out=tmp_path / "out").root) == contents(fake.root)


def test_a_listing_that_leads_out_of_the_folder_fetches_nothing(shared: Path, tmp_path: Path) -> None:
    (tmp_path / "shared/fake/prey").write_text("prey")
    digest = hashlib.sha256(b"prey").hexdigest()
    sums = (shared / "SHA256SUMS").read_text()
    for path in ("data/../../prey", "/etc/passwd", "../prey"):
        (shared / "SHA256SUMS").write_text(f"{sums}{digest}  {path}\n")
        with pytest.raises(SharingError, match=r"cannot be trusted.*Nothing was downloaded"):
            pull(source(shared), out=tmp_path / "out")
    assert not (tmp_path / "out").exists() and not hidden(tmp_path / "out")


@pytest.mark.parametrize(("key", "value"), [("name", "../../away"), ("name", ".."), ("name", 3), ("version", "9.0.0")])
def test_a_description_cannot_choose_its_place(key: str, value: object, shared: Path, home: Path) -> None:
    edit(DESCRIBED, **{key: value})(shared)
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
    edit(path, **change)(shared)
    resign(shared)
    with pytest.raises(SharingError, match="is not a complete dataset"):
        pull(source(shared), out=tmp_path / "new/place/out")
    assert not (tmp_path / "new").exists()


def test_whole_files_are_not_fetched_again_and_others_are(
    fake: Dataset, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    partial = tmp_path / ".out.pull-1.0.0"
    for path, content in (("meta/info.json", None), (DATA, b"x" * 1000), ("data/stranger", b"")):
        (partial / path).parent.mkdir(parents=True, exist_ok=True)
        (partial / path).write_bytes((fake.root / path).read_bytes() if content is None else content)
    fetched: list[str] = []
    fetch = sharing.fetch

    def watched(remote: RemoteFolder, path: str, folder: Path, most: int) -> int:
        fetched.append(path)
        return fetch(remote, path, folder, most)

    monkeypatch.setattr(sharing, "fetch", watched)
    pulled = pull(source(shared), out=tmp_path / "out")
    assert contents(pulled.root) == contents(fake.root) and DATA in fetched and "meta/info.json" not in fetched
    assert not hidden(tmp_path / "out")


def test_folders_in_folders_are_not_listed(shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A server may list one more in each, without end."""
    listed: list[str] = []
    ls = LocalFileSystem.ls

    def watched(self: LocalFileSystem, path: str, **options: object) -> object:
        listed.append(path)
        return ls(self, path, **options)

    monkeypatch.setattr(LocalFileSystem, "ls", watched)
    pull(source(shared), out=tmp_path / "out")
    assert set(listed) == {str(shared.parent)}


def test_of_very_many_folders_few_are_looked_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(sharing.MOST_NAMED + 30):
        (tmp_path / f"shared/{number}/more").mkdir(parents=True)
    asked, names = list[str](), UrlStore.names

    def watched(self: UrlStore) -> list[str]:
        asked.append(self.url)
        return names(self)

    monkeypatch.setattr(UrlStore, "names", watched)
    with pytest.raises(SharingError, match="has no dataset of astra-data"):
        pull(f"file://{tmp_path}/shared", out=tmp_path / "copy")
    assert len(asked) == sharing.MOST_NAMED + 2  # itself twice


def test_no_more_is_fetched_than_is_taken(shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the place does not know sizes, as some servers."""
    total = sum(len(content) for path, content in contents(shared).items() if path.startswith(("data", "meta")))
    facts = RemoteFolder.facts
    monkeypatch.setattr(RemoteFolder, "facts", lambda self, path: {**facts(self, path), "size": None})
    monkeypatch.setattr("astra_data.io.hub.stores.BLOCK_BYTES", 1000)
    with pytest.raises(SharingError, match=f"has more bytes, of which at most {total - 1} are taken"):
        pull(source(shared), out=tmp_path / "out", max_bytes=total - 1)
    assert pull(source(shared), out=tmp_path / "out", max_bytes=total).reference == "fake@data-1.0.0"


def test_a_full_disk_is_told_and_what_was_fetched_stays(
    fake: Dataset, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> Iterator[bytes]:
        yield b"x"
        raise OSError(errno.ENOSPC, "no space left")

    with monkeypatch.context() as patched:
        patched.setattr(RemoteFolder, "description", lambda _: json.loads((shared / DESCRIBED).read_text()))
        patched.setattr(RemoteFolder, "read_text", lambda *_: (shared / "SHA256SUMS").read_text())
        patched.setattr(RemoteFolder, "blocks", full)
        with pytest.raises(DiskError, match=r"data/\S+ cannot be written: the disk is full"):
            pull(source(shared), out=tmp_path / "out")
    assert contents(pull(source(shared), out=tmp_path / "out").root) == contents(fake.root)


def plant_link(folder: Path) -> None:
    (folder / "data/chunk-000").symlink_to(folder.parent / "elsewhere")


def plant_hard_link(folder: Path) -> None:
    (folder / "data/file").hardlink_to(folder.parent / "elsewhere/prey")


@pytest.mark.parametrize("plant", [plant_link, plant_hard_link, lambda folder: os.mkfifo(folder / "data/x")])
def test_what_was_planted_in_the_unfinished_folder_is_refused(
    shared: Path, tmp_path: Path, plant: Callable[[Path], None]
) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere/prey").write_text("prey")
    folder = tmp_path / ".out.pull-1.0.0"
    (folder / "data").mkdir(parents=True)
    plant(folder)
    with pytest.raises(SharingError, match="which no pull leaves there: delete"):
        pull(source(shared), out=tmp_path / "out")
    folder.rename(tmp_path / "moved")
    folder.symlink_to(tmp_path / "moved")
    with pytest.raises(SharingError, match="is a link"):
        pull(source(shared), out=tmp_path / "out")
    assert (tmp_path / "elsewhere/prey").read_text() == "prey"


@pytest.mark.parametrize("content", [b"[1]", b"{", b"3", b"\xff", None])
def test_a_description_that_is_none_is_told(shared: Path, tmp_path: Path, content: bytes | None) -> None:
    remote = RemoteFolder(fsspec.filesystem("file"), str(shared), "it@data-1.0.0")
    assert remote.description()["name"] == "fake"
    if content is None:
        (shared / DESCRIBED).unlink()
    else:
        (shared / DESCRIBED).write_bytes(content)
    with pytest.raises(SharingError, match=r"^it@data-1\.0\.0(: | has no )meta/astra/dataset\.json"):
        remote.description()


def test_an_altered_remote_is_told(fake: Dataset, shared: Path, tmp_path: Path) -> None:
    whole = (shared / DATA).read_bytes()
    for content in (whole[:-1] + b"?", whole + b"?", None):
        (shared / DATA).unlink()
        if content is not None:
            (shared / DATA).write_bytes(content)
        with pytest.raises(SharingError, match=r"was altered: data/.*Delete this version there"):
            push(fake.root, f"file://{tmp_path}/shared")
        (shared / DATA).write_bytes(whole)
    sums = (shared / "SHA256SUMS").read_text()
    policy = "meta/astra/policy.safetensors"
    lines = [line for line in sums.splitlines(keepends=True) if "meta/stats" not in line]
    for altered, path in (
        (sums.replace(sums[:64], "0" * 64), "data/"),
        (f"{sums}{'0' * 64}  {policy}\n", policy),
        ("".join(lines), "meta/stats.json"),
    ):
        (shared / "SHA256SUMS").write_text(altered)
        with pytest.raises(BadInputError, match=f"SHA256SUMS there differs in {path}"):
            push(fake.root, f"file://{tmp_path}/shared")


def test_a_push_names_where_it_put_the_version_and_how_far_it_is(fake: Dataset, tmp_path: Path) -> None:
    seen: list[float] = []
    place = f"file://{tmp_path}/shared"
    source = push(fake.root, place, progress=lambda fraction, note: seen.append(fraction))
    assert source == f"{place}/fake@data-1.0.0" and seen == sorted(seen) and (seen[0], seen[-1]) == (0.0, 1.0)
    files = contents(tmp_path / "shared/fake/data-1.0.0")
    assert files.keys() == contents(fake.root).keys() | {"README.md", "README-coverage.png", "SHA256SUMS"}


def test_a_second_push_sends_nothing(fake: Dataset, tmp_path: Path) -> None:
    push(fake.root, f"file://{tmp_path}/shared")
    before = contents(tmp_path / "shared")
    seen: list[float] = []
    push(fake.root, f"file://{tmp_path}/shared", progress=lambda fraction, note: seen.append(fraction))
    assert not seen and contents(tmp_path / "shared") == before


def test_notes_are_in_the_card_and_their_faults_are_told_before_anything_is_sent(fake: Dataset, tmp_path: Path) -> None:
    notes = tmp_path / "notes.toml"
    notes.write_text('sumary = "It runs."\n')
    with pytest.raises(RecipeError, match="did you mean 'summary'"):
        push(fake.root, f"file://{tmp_path}/shared", notes=notes)
    assert not (tmp_path / "shared").exists()
    notes.write_text('summary = "It runs."\n')
    push(fake.root, f"file://{tmp_path}/shared", notes=notes)
    assert "It runs." in (tmp_path / "shared/fake/data-1.0.0/README.md").read_text()


def test_altered_values_are_not_pushed(tmp_path: Path) -> None:
    dataset = write_fake(tmp_path / "mine")
    edit(DESCRIBED, content_hash="0" * 64)(dataset.root)
    with pytest.raises(CorruptDatasetError, match=r"dataset\.json was altered"):
        push(dataset.root, f"file://{tmp_path}/shared")
    assert not (tmp_path / "shared").exists()


def test_a_full_disk_is_told_with_the_folder_there(
    fake: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "no space left", str(fake.root))

    with monkeypatch.context() as patched:
        patched.setattr(LocalFileSystem, "put_file", full)
        with pytest.raises(DiskError, match=r"shared/fake cannot be written: the disk is full"):
            push(fake.root, f"file://{tmp_path}/shared")
    push(fake.root, f"file://{tmp_path}/shared")
    assert contents(tmp_path / "shared/fake/data-1.0.0").keys() > contents(fake.root).keys()
