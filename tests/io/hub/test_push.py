import errno
import json
from pathlib import Path
from unittest.mock import Mock

import pytest
from fake_dataset import write_fake
from fsspec.implementations.local import LocalFileSystem
from shared_files import contents

from astra_data.core.errors import BadInputError, CorruptDatasetError, DiskError, RecipeError, SharingError
from astra_data.dataset.reader import Dataset
from astra_data.io.hub.push import push

pytestmark = pytest.mark.usefixtures("quick_figure")


def test_a_push_names_where_it_put_the_version_and_how_far_it_is(fake: Dataset, tmp_path: Path) -> None:
    seen: list[float] = []
    place = f"file://{tmp_path}/shared"
    source = push(fake.root, place, progress=lambda fraction, note: seen.append(fraction))
    assert source == f"{place}/fake@data-1.0.0"
    assert seen == sorted(seen)
    assert (seen[0], seen[-1]) == (0.0, 1.0)
    files = contents(tmp_path / "shared/fake/data-1.0.0")
    assert files.keys() == contents(fake.root).keys() | {"README.md", "README-coverage.png", "SHA256SUMS"}


def test_values_are_read_once_to_be_checked(
    fake: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By `check`, which looks at more than `require_whole`."""
    again = Mock()
    monkeypatch.setattr(Dataset, "require_whole", again)
    push(fake.root, f"file://{tmp_path}/shared")
    again.assert_not_called()


def test_a_second_push_sends_nothing(fake: Dataset, tmp_path: Path) -> None:
    push(fake.root, f"file://{tmp_path}/shared")
    before = contents(tmp_path / "shared")
    seen: list[float] = []
    push(fake.root, f"file://{tmp_path}/shared", progress=lambda fraction, note: seen.append(fraction))
    assert not seen
    assert contents(tmp_path / "shared") == before


def test_notes_are_in_the_card_and_their_faults_are_told_before_anything_is_sent(
    fake: Dataset, tmp_path: Path
) -> None:
    notes = tmp_path / "notes.toml"
    notes.write_text('sumary = "It runs."\n')
    with pytest.raises(RecipeError, match="did you mean 'summary'"):
        push(fake.root, f"file://{tmp_path}/shared", notes=notes)
    assert not (tmp_path / "shared").exists()
    notes.write_text('summary = "It runs."\n')
    push(fake.root, f"file://{tmp_path}/shared", notes=notes)
    assert "It runs." in (tmp_path / "shared/fake/data-1.0.0/README.md").read_text()


def test_private_is_refused_where_the_storage_decides(fake: Dataset, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="private is for the Hugging Face Hub"):
        push(fake.root, f"file://{tmp_path}/shared", private=True)
    assert not (tmp_path / "shared").exists()


def test_a_place_that_is_none_is_told_before_the_dataset_is_opened(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="shared: expected user/name or "):
        push(tmp_path / "none", "shared")


def test_altered_values_are_not_pushed(tmp_path: Path) -> None:
    dataset = write_fake(tmp_path / "mine")
    description = json.loads((dataset.root / "meta/astra/dataset.json").read_text())
    text = json.dumps(description | {"content_hash": "0" * 64})
    (dataset.root / "meta/astra/dataset.json").write_text(text)
    with pytest.raises(CorruptDatasetError, match=r"dataset\.json was altered"):
        push(dataset.root, f"file://{tmp_path}/shared")
    assert not (tmp_path / "shared").exists()


def test_an_altered_remote_is_told(fake: Dataset, tmp_path: Path) -> None:
    push(fake.root, f"file://{tmp_path}/shared")
    shared = tmp_path / "shared/fake/data-1.0.0"
    path = shared / "data/chunk-000/file-000.parquet"
    whole = path.read_bytes()
    for content in (whole[:-1] + b"?", whole + b"?", None):
        path.unlink()
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(SharingError, match=r"was altered: data/.*Delete this version there"):
            push(fake.root, f"file://{tmp_path}/shared")
        path.write_bytes(whole)
    sums = (shared / "SHA256SUMS").read_text()
    (shared / "SHA256SUMS").write_text(sums.replace(sums[:64], "0" * 64))
    with pytest.raises(BadInputError, match=r"SHA256SUMS there lists other files as data/"):
        push(fake.root, f"file://{tmp_path}/shared")
    policy = "meta/astra/policy.safetensors"
    (shared / "SHA256SUMS").write_text(f"{sums}{'0' * 64}  {policy}\n# 1 bytes  {policy}\n")
    with pytest.raises(BadInputError, match=r"lists other files as meta/astra/policy\.safetensors: it was"):
        push(fake.root, f"file://{tmp_path}/shared")
    lines = sums.splitlines(keepends=True)
    (shared / "SHA256SUMS").write_text("".join(line for line in lines if "meta/stats" not in line))
    with pytest.raises(BadInputError, match=r"lists other files as meta/stats\.json: it was"):
        push(fake.root, f"file://{tmp_path}/shared")


def test_a_full_disk_is_told_with_the_folder_there(
    fake: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "no space left", str(fake.root))

    with monkeypatch.context() as patched:
        patched.setattr(LocalFileSystem, "put_file", full)
        with pytest.raises(DiskError, match=r"shared/fake/\S+ cannot be written: the disk is full"):
            push(fake.root, f"file://{tmp_path}/shared")
    push(fake.root, f"file://{tmp_path}/shared")
    assert contents(tmp_path / "shared/fake/data-1.0.0").keys() > contents(fake.root).keys()
