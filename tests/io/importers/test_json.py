import tarfile
from json import dumps
from pathlib import Path

import numpy as np
import pytest
from recordings import LENGTHS, LOG, MAPPING, imported, rows, write_table

from astra_data.core.errors import BadInputError
from astra_data.io.importers import json
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import Source


def test_json_that_is_too_large_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_table(tmp_path / "log.json", rows())
    monkeypatch.setattr(json, "LIMIT_BYTES", 100)
    with pytest.raises(BadInputError, match="split the file"):
        imported(tmp_path, path)


@pytest.mark.parametrize("empty", ["[]", "{}"])
def test_json_without_rows_is_told(tmp_path: Path, empty: str) -> None:
    (tmp_path / "log.json").write_text(empty)
    with pytest.raises(BadInputError, match=r"log.json is empty: nothing was recorded, leave it out"):
        imported(tmp_path, tmp_path / "log.json")


LISTS = ImportMapping.model_validate(
    {"name": "n", "task": "t", "fps": 1, "columns": {name: {"fields": (name,)} for name in ("x", "on")}}
)


@pytest.mark.parametrize("name", ["log.json", "log.jsonl"])
def test_null_among_numbers_is_no_number_as_an_empty_cell_is(tmp_path: Path, name: str) -> None:
    """Also in lists; text beside it stays what it is."""
    path = tmp_path / name
    x: list[object] = [[1, 0.5], [None, 2], [3, None]]
    on = [True, None, "a"]
    lines = "".join(f"{dumps({'x': x[row], 'on': on[row]})}\n" for row in range(3))
    path.write_text(lines if name.endswith("l") else dumps({"x": x, "on": on}))
    [block] = json.read(Source(path, None, path), LISTS)
    np.testing.assert_array_equal(block.values["x"], [[1.0, 0.5], [np.nan, 2.0], [3.0, np.nan]])
    assert block.values["on"].tolist() == on


def test_a_folder_and_an_archive_of_lines_become_episodes(tmp_path: Path) -> None:
    mapping = MAPPING.replace('field = "trial"', "")
    for name in ("1.jsonl", "2.jsonl"):
        write_table(tmp_path / "logs" / name, {k: v[: LENGTHS[0]] for k, v in rows().items()})
    with tarfile.open(tmp_path / "logs.tar.gz", "w:gz") as archive:
        archive.add(tmp_path / "logs", "logs")
    for recording in ("logs", "logs.tar.gz"):
        dataset, _ = imported(tmp_path / f"of_{recording}", tmp_path / recording, mapping)
        assert dataset.lengths.tolist() == [LENGTHS[0] - 1] * 2


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ('{"x": 1}', r"no field 'on'; known: x"),
        ("[1, 2]", "expected an object of fields, got list"),
        ('{"x": 1, "on": tru}', r"expected an object of fields \(Expecting value"),
        ('{"x": 1, "x": 2, "on": 1}', r"expected an object of fields \(an object has x more than once\)"),
    ],
)
def test_a_line_that_is_no_row_is_told_with_its_place(tmp_path: Path, line: str, told: str) -> None:
    path = tmp_path / "log.jsonl"
    path.write_text(f'{{"x": 1, "on": true}}\n{line}\n{{"x": 1, "on": true}}\n')
    with pytest.raises(BadInputError, match=rf"log\.jsonl line 2: {told}"):
        list(json.read(Source(path, None, path), LISTS))


def test_a_last_line_that_is_cut_off_is_counted(tmp_path: Path) -> None:
    (path := tmp_path / "log.json").write_text('{"x": 1, "x": 2}')
    with pytest.raises(BadInputError, match=r"log\.json: an object has x more than once"):
        list(json.read(Source(path, None, path), LISTS))
    path = tmp_path / "log.jsonl"
    for tail, torn, more in (("", 0, 0), ('{"x": 1, "on": tr', 1, 0), ('{"x": 1, "on": true}', 0, 1)):
        path.write_text('{"x": 1, "on": true}\n' * 3 + tail)
        [block] = json.read(Source(path, None, path), LISTS)
        assert (len(block), block.torn) == (3 + more, torn)


def test_lines_that_are_blank_are_counted(tmp_path: Path) -> None:
    fields = rows()
    fields["x"][3] = np.nan
    path = write_table(tmp_path / "log.jsonl", fields)
    lines = path.read_text().splitlines()
    path.write_text("\n".join(["", *lines[:2], "", "  ", *lines[2:], "", '{"x": 1']))
    _, report = imported(tmp_path, path, 'not_finite = "split"\n' + MAPPING)
    assert report.tally.faults == "x in 1 row, log.jsonl line 7"
    assert report.tally.torn_first == f"log.jsonl line {len(lines) + 5}"


@pytest.mark.parametrize("kind", ["object", "list", "lines"])
def test_objects_in_objects_are_fields_with_both_names(tmp_path: Path, kind: str) -> None:
    rows_ = [{"pose": {"at": [k, -k], "yaw": {"rad": 0.5 * k}}, "u": k} for k in range(6)]
    path = tmp_path / ("log.jsonl" if kind == "lines" else "log.json")
    if kind == "object":
        at, yaw = [row["pose"]["at"] for row in rows_], [row["pose"]["yaw"]["rad"] for row in rows_]  # type: ignore[index]
        path.write_text(dumps({"pose": {"at": at, "yaw": {"rad": yaw}}, "u": list(range(6))}))
    else:
        path.write_text(dumps(rows_) if kind == "list" else "\n".join(map(dumps, rows_)))
    mapping = f"""{LOG}[columns."observation.state"]
fields = ["pose/at", "pose/yaw/rad"]
"""
    dataset, report = imported(tmp_path, path, mapping)
    assert dataset.columns(["observation.state"])["observation.state"].tolist() == [[k, -k, 0.5 * k] for k in range(5)]
    assert report.tally.unused_fields == ["u"]
    with pytest.raises(BadInputError, match=r"no field 'pose/yaw'.*(known: |did you mean ')"):
        imported(tmp_path / "bad", path, mapping.replace("pose/yaw/rad", "pose/yaw"))
