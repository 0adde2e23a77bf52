"""Storage at URLs: a local folder, memory, and a server that speaks S3."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fake_dataset import DESCRIPTION, write_fake
from fsspec.implementations.local import LocalFileSystem
from moto.server import ThreadedMotoServer
from shared_files import contents

from astra_data.core.errors import BadInputError, SharingError
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import Version
from astra_data.io.hub.sharing import pull, push
from astra_data.io.hub.stores import (
    SUMS_PATH,
    UrlStore,
    dataset_files,
    is_address,
    make_sums,
    parse_place,
    parse_source,
    parse_sums,
)

pytestmark = pytest.mark.usefixtures("quick_figure")


@pytest.fixture(scope="session")
def s3_endpoint() -> Iterator[str]:
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture
def s3(s3_endpoint: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """Make an empty bucket and set what the AWS tools read; its name."""
    settings = {
        "AWS_ENDPOINT_URL_S3": s3_endpoint,
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_CONFIG_FILE": str(tmp_path / "none"),
        "AWS_SHARED_CREDENTIALS_FILE": str(tmp_path / "none"),
    }
    for key, value in settings.items():
        monkeypatch.setenv(key, value)
    bucket = tmp_path.name.replace("_", "-").lower()
    fsspec.filesystem("s3", skip_instance_cache=True).mkdir(bucket)
    return f"s3://{bucket}/shared"


@pytest.fixture(params=["file", "memory"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An empty place of each kind without a server."""
    return f"file://{tmp_path}/shared" if request.param == "file" else f"memory://{tmp_path.name}"


@pytest.fixture(params=["file", "memory", "s3"])
def any_place(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An empty place of each kind."""
    kinds = {"file": f"file://{tmp_path}/shared", "memory": f"memory://{tmp_path.name}"}
    return kinds.get(request.param) or str(request.getfixturevalue("s3"))


def changed(root: Path) -> Dataset:
    """Write the fake dataset's version again with other values."""
    return write_fake(root, fps=10)


def test_what_is_pulled_is_what_was_pushed(any_place: str, fake: Dataset, home: Path) -> None:
    assert push(fake.root, any_place) == f"{any_place}/fake@data-1.0.0"
    pulled = pull(f"{any_place}/fake")
    assert pulled.root == home / "fake/data-1.0.0" and contents(pulled.root) == contents(fake.root)
    assert os.listdir(home / "fake") == ["data-1.0.0"]
    filesystem, path = fsspec.core.url_to_fs(f"{any_place}/fake/data-1.0.0")
    assert "# fake" in filesystem.cat_file(f"{path}/README.md").decode()
    assert filesystem.cat_file(f"{path}/README-coverage.png").startswith(b"\x89PNG")


def test_a_version_there_never_changes(any_place: str, fake: Dataset, tmp_path: Path) -> None:
    push(fake.root, any_place)
    filesystem, path = fsspec.core.url_to_fs(f"{any_place}/fake/data-1.0.0/SHA256SUMS")
    push(fake.root, any_place)
    filesystem.pipe_file(path, b"altered")
    with pytest.raises(SharingError, match=r"SHA256SUMS cannot be trusted"):
        push(fake.root, any_place)
    assert filesystem.cat_file(path) == b"altered"
    filesystem.rm_file(path)
    filesystem.rm_file(path.replace("SHA256SUMS", "meta/info.json"))
    with pytest.raises(SharingError, match=r"data-1\.0\.0 has no SHA256SUMS"):
        push(changed(tmp_path / "changed").root, any_place)


def test_the_newest_version_is_pulled_unless_another_is_named(place: str, fake: Dataset, tmp_path: Path) -> None:
    push(fake.root, place)
    for version in ("1.10.0", "1.9.0"):
        push(write_fake(tmp_path / version, description={**DESCRIPTION, "version": version}).root, place)
    assert pull(f"{place}/fake", out=tmp_path / "a").description["version"] == "1.10.0"
    assert pull(f"{place}/fake", out=tmp_path / "b", version="1.9.0").description["version"] == "1.9.0"
    assert pull(f"{place}/fake@data-1.0.0", out=tmp_path / "c").description["version"] == "1.0.0"
    with pytest.raises(
        BadInputError, match=r"no version data-2\.0\.0; it has data-1\.0\.0, data-1\.9\.0, data-1\.10\.0"
    ):
        pull(f"{place}/fake", version="2.0.0")
    with pytest.raises(BadInputError, match=r"names data-1\.0\.0, but the version asked for is 1\.9\.0"):
        pull(f"{place}/fake@data-1.0.0", version="1.9.0")


def stopped(place: str) -> tuple[Any, str]:
    """Make the pushed version one whose upload was stopped on its way; its file system and folder."""
    filesystem, path = fsspec.core.url_to_fs(f"{place}/fake/data-1.0.0")
    filesystem.rm_file(f"{path}/meta/astra/dataset.json")
    filesystem.rm_file(f"{path}/meta/info.json")
    filesystem.pipe_file(f"{path}/data/chunk-000/file-000.parquet", b"a part")
    return filesystem, path


def test_an_upload_that_stopped_is_not_there_and_is_finished_by_the_next(
    place: str, fake: Dataset, tmp_path: Path
) -> None:
    push(fake.root, place)
    stopped(place)
    with pytest.raises(SharingError, match="has no dataset of astra-data"):
        pull(f"{place}/fake", out=tmp_path / "out")
    push(fake.root, place)
    assert contents(pull(f"{place}/fake", out=tmp_path / "out").root) == contents(fake.root)


def test_a_folder_of_datasets_is_answered_with_their_addresses(place: str, fake: Dataset, tmp_path: Path) -> None:
    other = write_fake(tmp_path / "other", description={**DESCRIPTION, "name": "walks"})
    for dataset in (other, fake):
        push(dataset.root, place)
    filesystem, path = fsspec.core.url_to_fs(place)
    filesystem.makedirs(f"{path}/notes", exist_ok=True)
    filesystem.pipe_file(f"{path}/notes/read.me", b"no dataset")
    with pytest.raises(BadInputError) as refused:
        pull(place, out=tmp_path / "out")
    assert str(refused.value) == f"{place} is a folder of datasets: pull one of {place}/fake, {place}/walks"
    assert pull(f"{place}/walks", out=tmp_path / "out").reference == "walks@data-1.0.0"


def test_what_else_is_in_the_folder_is_left_there(place: str, fake: Dataset, tmp_path: Path) -> None:
    filesystem, path = fsspec.core.url_to_fs(f"{place}/fake/data-1.0.0")
    filesystem.makedirs(path, exist_ok=True)
    filesystem.pipe_file(f"{path}/precious.parquet", b"of somebody else")
    with pytest.raises(BadInputError, match=r"/fake/data-1\.0\.0 exists already and holds something else"):
        push(fake.root, place)
    assert [name.rpartition("/")[2] for name in filesystem.find(path)] == ["precious.parquet"]
    filesystem.rm(path, recursive=True)
    push(changed(tmp_path / "changed").root, place)
    stopped(place)
    before = filesystem.cat(filesystem.find(path))
    with pytest.raises(BadInputError, match="a part of another push of this version"):
        push(fake.root, place)
    assert filesystem.cat(filesystem.find(path)) == before


def at_the_third_file(monkeypatch: pytest.MonkeyPatch, act: Callable[[], object]) -> list[str]:
    """Let `act` happen before a push to a local folder sends its third file; lists what was sent."""
    put, sent = LocalFileSystem.put_file, list[str]()

    def watched(self: LocalFileSystem, file: str, path: str) -> None:
        sent.append(path)
        if len(sent) == 3:
            act()
        put(self, file, path)

    monkeypatch.setattr(LocalFileSystem, "put_file", watched)
    return sent


def test_a_second_push_at_once_takes_nothing_from_the_first(
    fake: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = changed(tmp_path / "changed")

    def second() -> None:
        with pytest.raises(BadInputError, match="going on right now"):
            push(other.root, f"file://{tmp_path}/shared")

    sent = at_the_third_file(monkeypatch, second)
    push(fake.root, f"file://{tmp_path}/shared")
    assert len(sent) == len(contents(fake.root)) + 1
    assert contents(pull(f"file://{tmp_path}/shared/fake", out=tmp_path / "out").root) == contents(fake.root)


def test_missing_rights_are_told(s3: str, fake: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    store = UrlStore(f"{s3}/fake")

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError("Access Denied")

    monkeypatch.setattr(store._filesystem, "ls", refuse)
    with pytest.raises(SharingError, match=r"no rights to do this .*check the credentials"):
        store.versions()


@pytest.mark.parametrize(("url", "module", "extra"), [("s3://b/x", "s3fs", "s3"), ("gs://b/x", "gcsfs", "gcs")])
def test_a_missing_back_end_is_told(url: str, module: str, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    known = sys.modules["fsspec.registry"].__dict__["_registry"]  # fsspec remembers what it has imported before
    monkeypatch.delitem(known, url.partition(":")[0], raising=False)
    told = rf"is not installed: uv sync --extra {extra}"
    with pytest.raises(BadInputError, match=told):
        UrlStore(url)


def test_what_a_killed_push_left_does_not_stop_the_next(fake: Dataset, tmp_path: Path) -> None:
    left = tmp_path / "shared/fake/data-1.0.0/.SHA256SUMS.tmp-999999999"
    left.mkdir(parents=True)
    (left / "SHA256SUMS").write_text("hal")
    push(fake.root, f"file://{tmp_path}/shared")
    assert contents(pull(f"file://{tmp_path}/shared/fake", out=tmp_path / "out").root) == contents(fake.root)
    assert not left.exists()


@pytest.mark.parametrize(
    ("text", "place", "version"),
    [
        ("me/it", "hf://datasets/me/it", None),
        ("hf://datasets/me/it", "hf://datasets/me/it", None),
        ("me/it@data-1.2.0", "hf://datasets/me/it", "1.2.0"),
        ("hf://datasets/me/it@1.2.0", "hf://datasets/me/it", "1.2.0"),
        ("s3://bucket/ant", "s3://bucket/ant", None),
        ("s3://bucket/ant/", "s3://bucket/ant", None),
        ("s3://bucket/ant/data-1.2.0", "s3://bucket/ant", "1.2.0"),
        ("file:///tmp/ant@data-10.2.0", "file:///tmp/ant", "10.2.0"),
    ],
)
def test_places_and_versions(text: str, place: str, version: str | None) -> None:
    found, named = parse_source(text)
    assert (str(found), named) == (place, Version.parse(version) if version else None)


@pytest.mark.parametrize("text", ["ant", "a/b/c", "hf://models/me/it", "hf://me/it", "", "s3://"])
def test_anything_else_is_told(text: str) -> None:
    with pytest.raises(BadInputError, match="expected user/name or hf://datasets/user/name"):
        parse_place(text)


def test_a_folder_is_a_place_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for text in ("./shared", f"{tmp_path}/shared"):
        assert str(parse_place(text)) == f"file://{tmp_path}/shared"
    assert str(parse_place("./My Läufe")) == f"file://{tmp_path}/My Läufe"
    assert str(parse_place("~/shared")) == f"file://{Path.home()}/shared"
    found, version = parse_source(f"{tmp_path}/it@data-1.2.0")
    assert (str(found), version) == (f"file://{tmp_path}/it", Version(1, 2, 0))


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        ("me/it", True),
        ("me/it@data-1.2.0", True),
        ("s3://bucket/a/b/ant", True),
        ("ant", False),
        ("ant@data-1.2.0", False),
        ("runs/cart/pair", False),
        ("./it", False),
        ("../me/it", False),
        ("/it", False),
    ],
)
def test_an_address_is_told_from_a_folder_and_a_name(data: str, expected: bool) -> None:
    assert is_address(data) is expected


def test_a_folder_that_is_there_is_no_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("me/it").mkdir(parents=True)
    assert not is_address("me/it") and is_address("you/it")


DIGEST = "0" * 64
DATA = "data/chunk-000/file-000.parquet"


def test_sums_are_those_of_sha256sum(fake: Dataset, tmp_path: Path) -> None:
    (tmp_path / SUMS_PATH).write_text(make_sums(fake.root))
    told = subprocess.run(["sha256sum", "-c", tmp_path / SUMS_PATH], cwd=fake.root, capture_output=True, text=True)
    assert told.returncode == 0
    assert told.stdout.count(": OK") == len(contents(fake.root)) == len(parse_sums(make_sums(fake.root), "it"))


def test_other_files_in_the_folder_are_left_out(tmp_path: Path) -> None:
    others = ("data/.hidden", "meta/.git/x", "README.md", "notes/a", "data/evil.sh", "meta/evil.json")
    kept = [DATA, "meta/info.json", "videos/front câm/chunk-000/file-000.mp4"]
    for path in (*others, *kept):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    assert dataset_files(tmp_path) == kept


def test_a_path_that_is_none_of_a_dataset_is_refused() -> None:
    paths = [
        *("../x", "/etc/passwd", "data/../../x", "data/..", "data/./x", "data//x", "data/", "meta"),
        *("data\\..\\x", "C:/x", "data/x\0y", "data/~/.ssh", "README.md", ".cache/x", "data/.x", "data/x y"),
        *("data/evil.sh", "data/chunk-000/x.sh", "data/chunk-000/file-000.parquet.py", "meta/astra/x.pkl"),
        *("data/chunk-\u0660\u0660\u0660/file-000.parquet", "meta/evil.json", "meta/astra/a/b.json"),
        "videos/../chunk-000/file-000.mp4",
    ]
    for path in paths:
        with pytest.raises(SharingError, match="expected one of a dataset's files, within data/, meta/ or videos/"):
            parse_sums(f"{DIGEST}  meta/info.json\n{DIGEST}  {path}\n", "it")


def test_every_fault_is_told() -> None:
    lines = ["nonsense", f"{DIGEST}  {DATA}", f"{DIGEST}  {DATA}", f"{DIGEST}  ../c"]
    with pytest.raises(SharingError) as told:
        parse_sums("\n".join(lines), "it")
    for fault in ("line 1 is no", f"line 3 lists {DATA} again", "'../c'"):
        assert fault in str(told.value)


def test_files_on_another_disk_belong_to_the_dataset_as_well(fake: Dataset, tmp_path: Path) -> None:
    root = Path(shutil.copytree(fake.root, tmp_path / "set"))
    expected = make_sums(root)
    (root / "data").rename(tmp_path / "elsewhere")
    (root / "data").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    (root / "a").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    (root / "b").symlink_to(root / "meta", target_is_directory=True)
    assert make_sums(root) == expected
