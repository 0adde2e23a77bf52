import subprocess
from pathlib import Path

import pytest
from shared_files import contents

from astra_data.core.errors import SharingError
from astra_data.dataset import Dataset
from astra_data.exchange.sharing.sums import SUMS_PATH, dataset_files, make_sums, parse_sums

DIGEST = "0" * 64


def test_sums_are_those_of_sha256sum(fake: Dataset, tmp_path: Path) -> None:
    (tmp_path / SUMS_PATH).write_text(make_sums(fake.root))
    told = subprocess.run(
        ["sha256sum", "-c", tmp_path / SUMS_PATH], cwd=fake.root, capture_output=True, text=True
    )
    assert told.returncode == 0
    assert (
        told.stdout.count(": OK") == len(contents(fake.root)) == len(parse_sums(make_sums(fake.root), "it"))
    )


def test_other_files_in_the_folder_are_left_out(tmp_path: Path) -> None:
    for path in ("data/a.parquet", "data/.hidden", "meta/.git/x", "README.md", "notes/a", "meta/info.json"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    assert dataset_files(tmp_path) == ["data/a.parquet", "meta/info.json"]


@pytest.mark.parametrize(
    "path",
    [
        *("../x", "/etc/passwd", "data/../../x", "data/..", "data/./x", "data//x", "data/", "meta"),
        *("data\\..\\x", "C:/x", "data/x\0y", "data/~/.ssh", "README.md", ".cache/x", "data/.x", "data/x y"),
    ],
)
def test_a_path_that_is_none_of_a_dataset_is_refused(path: str) -> None:
    with pytest.raises(SharingError, match="expected one within data/ or meta/"):
        parse_sums(f"{DIGEST}  meta/info.json\n{DIGEST}  {path}\n", "it")


def test_every_fault_is_told() -> None:
    lines = ["nonsense", f"{DIGEST}  data/a", f"{DIGEST}  data/a", f"{DIGEST}  data/a/b", f"{DIGEST}  ../c"]
    with pytest.raises(SharingError) as told:
        parse_sums("\n".join(lines), "it")
    for fault in ("line 1 is no", "line 3 lists data/a again", "data/a is listed as a file and", "'../c'"):
        assert fault in str(told.value)
