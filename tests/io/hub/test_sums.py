import shutil
import subprocess
from pathlib import Path

import pytest
from shared_files import contents

from astra_data.core.errors import SharingError
from astra_data.dataset.reader import Dataset
from astra_data.io.hub.stores import SUMS_PATH, dataset_files, make_sums, parse_sums

DIGEST = "0" * 64
DATA = "data/chunk-000/file-000.parquet"


def test_sums_are_those_of_sha256sum(fake: Dataset, tmp_path: Path) -> None:
    (tmp_path / SUMS_PATH).write_text(make_sums(fake.root))
    told = subprocess.run(["sha256sum", "-c", tmp_path / SUMS_PATH], cwd=fake.root, capture_output=True, text=True)
    assert told.returncode == 0
    assert told.stdout.count(": OK") == len(contents(fake.root)) == len(parse_sums(make_sums(fake.root), "it"))


def test_other_files_in_the_folder_are_left_out(tmp_path: Path) -> None:
    others = ("data/.hidden", "meta/.git/x", "README.md", "notes/a", "data/evil.sh", "meta/evil.json")
    for path in (*others, DATA, "meta/info.json"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    assert dataset_files(tmp_path) == [DATA, "meta/info.json"]


@pytest.mark.parametrize(
    "path",
    [
        *("../x", "/etc/passwd", "data/../../x", "data/..", "data/./x", "data//x", "data/", "meta"),
        *("data\\..\\x", "C:/x", "data/x\0y", "data/~/.ssh", "README.md", ".cache/x", "data/.x", "data/x y"),
        *("data/evil.sh", "data/chunk-000/x.sh", "data/chunk-000/file-000.parquet.py", "meta/astra/x.pkl"),
        *("data/chunk-\u0660\u0660\u0660/file-000.parquet", "meta/evil.json", "meta/astra/a/b.json"),
    ],
)
def test_a_path_that_is_none_of_a_dataset_is_refused(path: str) -> None:
    with pytest.raises(SharingError, match="expected one of a dataset's files, within data/ or meta/"):
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
