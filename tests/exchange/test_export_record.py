import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
from fake_dataset import COLUMNS, write_fake

from astra_data.core.errors import CorruptDatasetError
from astra_data.exchange.export_record import Export, ExportRecord


@pytest.fixture
def record(tmp_path: Path) -> dict[str, Any]:
    """The record of the fake dataset, once all its episodes were exported."""
    export = Export(write_fake(tmp_path / "set"), {column.name: column.name for column in COLUMNS})
    for _ in export.episodes():
        pass
    return json.loads(export.text())  # type: ignore[no-any-return]


def test_a_record_says_what_the_dataset_is(record: dict[str, Any], tmp_path: Path) -> None:
    dataset = write_fake(tmp_path / "again")
    read = ExportRecord.parse(json.dumps(record), "here")
    assert read.columns == list(COLUMNS)
    assert read.identity == dataset.identity
    assert list(read.uids) == dataset.uids.tolist()
    assert {key: list(facts) for key, facts in read.metadata.items()} == dataset.metadata
    values = dataset.columns([column.name for column in COLUMNS])
    assert read.sums == {name: hashlib.sha256(array.tobytes()).hexdigest() for name, array in values.items()}


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"uids": [1]}, "expected as many entries in each"),
        ({"sums": {}}, "expected the same columns in all of them"),
        ({"fps": 0}, "fps: Input should be greater"),
        ({"metadata": {"return": [float("inf")]}}, "metadata"),
        ({"name": "../up"}, "name: String should match"),
        ({"more": 1}, "more: Extra inputs"),
    ],
)
def test_a_malformed_record_is_one_line(record: dict[str, Any], change: dict[str, Any], fault: str) -> None:
    with pytest.raises(CorruptDatasetError, match=fault) as caught:
        ExportRecord.parse(json.dumps(record | change), "here")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", "[" * 10000, b"\xff", "null"])
def test_no_record_is_one_line(text: str | bytes) -> None:
    with pytest.raises(CorruptDatasetError, match="here: its record of the export is malformed"):
        ExportRecord.parse(text, "here")
