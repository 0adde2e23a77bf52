"""The Hugging Face Hub, played by a server on loopback to the real huggingface_hub."""

from pathlib import Path
from typing import Any

import pytest
from fake_dataset import DESCRIPTION, write_fake
from fake_hub import Hub, Repository
from shared_files import contents

from astra_data.core.errors import BadInputError, SharingError
from astra_data.dataset.reader import Dataset
from astra_data.io.hub.sharing import pull, push

pytestmark = [
    pytest.mark.usefixtures("quick_figure"),
    # Of httpx, about how huggingface_hub sends large files.
    pytest.mark.filterwarnings("ignore:Use 'content=:DeprecationWarning"),
]

DATA = "data/chunk-000/file-000.parquet"


def versioned(root: Path, version: str, **changes: Any) -> Dataset:
    return write_fake(root, description={**DESCRIPTION, "version": version}, **changes)


def test_what_is_pulled_is_what_was_pushed(hub: Hub, fake: Dataset, home: Path) -> None:
    told: list[tuple[float, str]] = []
    pushed = push(fake.root, "me/it", progress=lambda share, note: told.append((share, note)))
    assert pushed == "hf://datasets/me/it@data-1.0.0" and (sorted(told), told[-1]) == (told, (1.0, "data-1.0.0"))
    repo = hub.repos["me/it"]
    assert not repo.private and repo.history == ["initial commit", "Add fake@data-1.0.0"]
    assert repo.tags == {"v3.0": repo.head, "data-1.0.0": repo.head}
    assert b'LeRobotDataset("me/it", revision="data-1.0.0")' in repo.commits[repo.head]["README.md"]
    pulled = pull("me/it")
    assert pulled.root == home / "fake/data-1.0.0" and contents(pulled.root) == contents(fake.root)


def test_every_version_keeps_its_tag_and_main_shows_the_newest(hub: Hub, fake: Dataset, tmp_path: Path) -> None:
    push(fake.root, "me/it")
    repo = hub.repos["me/it"]
    first = dict(repo.tags)
    left = repo.commits[repo.head] | {  # a file of an earlier version that the next one does not have
        "data/chunk-000/file-001.parquet": b"",
        "meta/old.json": b"",
        "videos/a/old.mp4": b"",
        "LICENSE": b"",
    }
    repo.commit(left, "more files")
    newer = versioned(tmp_path / "newer", "1.10.0", fps=10)
    push(newer.root, "me/it")
    assert repo.tags == {"data-1.0.0": first["data-1.0.0"], "data-1.10.0": repo.head, "v3.0": repo.head}
    files = repo.commits[repo.head]
    assert set(files) - set(contents(newer.root)) == {
        *(".gitattributes", "LICENSE", "README.md", "README-coverage.png", "SHA256SUMS")
    }
    push(fake.root, "me/it")  # it is there, though not the newest
    repo.tags = dict(sorted(repo.tags.items(), reverse=True))
    assert contents(pull("me/it", out=tmp_path / "a").root) == contents(newer.root)
    assert contents(pull("me/it@data-1.0.0", out=tmp_path / "b").root) == contents(fake.root)
    with pytest.raises(BadInputError, match=r"no version data-3\.0\.0; it has data-1\.0\.0, data-1\.10\.0"):
        pull("me/it", version="3.0.0")
    with pytest.raises(BadInputError, match=r"has data-1\.10\.0 already.*data-1\.9\.0 can no longer be added"):
        push(versioned(tmp_path / "late", "1.9.0").root, "me/it")


def test_an_altered_file_there_is_told_without_a_download(hub: Hub, fake: Dataset) -> None:
    push(fake.root, "me/it")
    repo = hub.repos["me/it"]
    files = repo.commits[repo.head]
    files[DATA] = files[DATA][:-1] + b"?"
    with pytest.raises(SharingError, match=f"was altered: {DATA} there differ"):
        push(fake.root, "me/it")
    assert not [asked for asked in hub.ranges if DATA in asked]


def test_a_push_that_stopped_is_finished_by_the_next(hub: Hub, fake: Dataset, tmp_path: Path) -> None:
    tagged: list[str] = []

    def no_second_tag(method: str, path: str) -> int | None:
        tagged.extend([path] if "/tag/" in path else [])
        return 500 if "/tag/" in path and len(tagged) == 2 else None

    hub.refuse = no_second_tag
    with pytest.raises(SharingError, match=r"it answered 500: refused$"):
        push(fake.root, "me/it")
    assert set(hub.repos["me/it"].tags) == {"v3.0"}
    with pytest.raises(SharingError, match="has no dataset of astra-data"):
        pull("me/it", out=tmp_path / "out")
    hub.refuse = lambda method, path: None
    push(fake.root, "me/it")
    assert contents(pull("me/it", out=tmp_path / "out").root) == contents(fake.root)


def test_a_commit_never_goes_on_top_of_one_that_came_between(hub: Hub, fake: Dataset) -> None:
    def another(method: str, path: str) -> None:
        if path.endswith("/commit/main"):
            hub.repos["me/it"].commit({}, "of somebody else")

    hub.refuse = another
    with pytest.raises(SharingError, match="changed by somebody else at the same time"):
        push(fake.root, "me/it")
    repo = hub.repos["me/it"]
    assert (repo.history[-1], repo.tags) == ("of somebody else", {})
    hub.refuse = lambda method, path: 409 if path.endswith("/commit/main") else None
    with pytest.raises(SharingError, match="changed by somebody else at the same time"):
        push(fake.root, "me/it")


def test_tags_name_what_was_pushed_though_somebody_else_goes_on(hub: Hub, fake: Dataset) -> None:
    def another(method: str, path: str) -> None:
        if "/tag/" in path:
            hub.repos["me/it"].commit({}, "of somebody else")

    hub.refuse = another
    push(fake.root, "me/it")
    repo = hub.repos["me/it"]
    pushed = list(repo.commits)[repo.history.index("Add fake@data-1.0.0")]
    assert repo.tags == {"v3.0": pushed, "data-1.0.0": pushed} and pushed != repo.head


def test_a_public_repository_does_not_get_what_is_to_be_private(hub: Hub, fake: Dataset) -> None:
    hub.repos["me/it"] = Repository()
    with pytest.raises(BadInputError, match=r"me/it exists already and is public, .*Nothing was uploaded"):
        push(fake.root, "me/it", private=True)
    assert hub.repos["me/it"].history == ["initial commit"] and not hub.large
    hub.repos["me/it"].private = True
    push(fake.root, "me/it", private=True)
    assert "data-1.0.0" in hub.repos["me/it"].tags
    hub.visibility = "private"  # which nobody asked to change
    push(fake.root, "me/other")
    assert hub.repos["me/other"].private


def test_missing_rights_are_told(hub: Hub, fake: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_TOKEN", "hf_other")
    with pytest.raises(SharingError, match="no rights to do this; log in with `hf auth login`"):
        push(fake.root, "me/it")
    assert not hub.repos


def test_a_repository_that_does_not_exist_is_told(hub: Hub) -> None:
    with pytest.raises(SharingError, match="me/none on the Hugging Face Hub: no such dataset"):
        pull("me/none")


def test_a_name_that_the_hub_does_not_take_is_told(hub: Hub, fake: Dataset) -> None:
    for name in ("me/a--b", "me/it.git"):
        with pytest.raises(BadInputError, match="not a valid repository name"):
            push(fake.root, name)
        with pytest.raises(BadInputError, match="not a valid repository name"):
            pull(name)


def test_no_network_is_told(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(SharingError, match=r"ConnectError: .*check the address"):
        pull("me/it")


def test_an_upload_that_breaks_off_is_told(hub: Hub, fake: Dataset) -> None:
    hub.refuse = lambda method, path: 403 if method == "PUT" else None
    with pytest.raises(SharingError, match="me/it on the Hugging Face Hub: no rights to do this"):
        push(fake.root, "me/it")
    assert hub.repos["me/it"].tags == {}


def test_a_card_that_the_hub_refuses_is_told(hub: Hub, fake: Dataset, tmp_path: Path) -> None:
    (tmp_path / "notes.toml").write_text('license = "none-such"\n')
    with pytest.raises(BadInputError, match=r'rejects this: (.|\n)*"license" must be one of a list'):
        push(fake.root, "me/it", notes=tmp_path / "notes.toml")
    assert hub.repos["me/it"].history == ["initial commit"]
    push(fake.root, "me/it")
    assert set(hub.repos["me/it"].tags) == {"v3.0", "data-1.0.0"}


def test_a_plain_lerobot_dataset_is_neither_pulled_nor_overwritten(hub: Hub, fake: Dataset) -> None:
    repo = hub.repos["me/it"] = Repository()
    repo.commit({"meta/info.json": b"{}", "data/chunk-000/file-000.parquet": b""}, "by lerobot")
    repo.tags["v3.0"] = repo.head
    with pytest.raises(SharingError, match="A plain LeRobot dataset is opened with lerobot"):
        pull("me/it")
    with pytest.raises(BadInputError, match="holds a dataset that astra-data did not push"):
        push(fake.root, "me/it")
    repo.tags["data-1.0.0"] = repo.head
    with pytest.raises(SharingError, match=r"has no meta/astra/dataset\.json: it was not pushed by astra-data"):
        pull("me/it")
    assert repo.history[-1] == "by lerobot"


def test_another_dataset_is_not_mixed_with_the_one_there(hub: Hub, fake: Dataset, tmp_path: Path) -> None:
    push(fake.root, "me/it")
    other = write_fake(tmp_path / "other", description={**DESCRIPTION, "name": "other", "version": "2.0.0"})
    with pytest.raises(BadInputError, match="holds the dataset 'fake'"):
        push(other.root, "me/it")
