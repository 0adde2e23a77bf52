import re
import tarfile
from pathlib import Path

import numpy as np
import pytest
from recordings import LOG, MAPPING, imported, rows, write_table

from astra_data.core.errors import BadInputError
from astra_data.io.importers import csv
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import Source

STAMPED = MAPPING.replace('fields = ["gait"]', 'fields = ["stamp"]')


def test_csv_whose_later_blocks_look_different(tmp_path: Path) -> None:
    n = 60_000  # two blocks of 1 MB: whole numbers and labels that look like numbers first, then others
    lines = [f"{i},1,0,0,0,1,2,{'0' * 20}\n" for i in range(n)]
    lines += [f"{i}.5,,0.5,0,0,1,b,zzz\n" for i in range(n)]
    path = tmp_path / "log.csv"
    path.write_text("x,y,command,reward,fell,gait,trial,unused\n" + "".join(lines))
    dataset, report = imported(tmp_path, path, 'not_finite = "drop"\n' + MAPPING)
    assert report.tally.rejected_rows == n and report.tally.faults == f"y in {n} rows, first log.csv line {n + 2}"
    assert dataset.lengths.tolist() == [n - 1]


@pytest.mark.parametrize("last", ["", "0.5"])
def test_integers_that_floats_would_alter_are_told(tmp_path: Path, last: str) -> None:
    stamps = np.array(["-1700000000050000002"] * 19 + [last])
    path = write_table(tmp_path / "log.csv", rows() | {"stamp": stamps})
    told = r"numbers of 2\^53 or more came as floats" if not last else "expected whole numbers"
    with pytest.raises(BadInputError, match=f"gait: {told}"):
        imported(tmp_path, path, 'not_finite = "drop"\n' + STAMPED)
    assert not (tmp_path / "out").exists()


def test_cells_are_numbers_flags_or_nothing(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("whole,float,flag,gap\n9007199254740993,0.5,true,1\n-2,1e3,false,\n")
    columns = {name: {"fields": (name,)} for name in ("whole", "float", "flag", "gap")}
    mapping = ImportMapping.model_validate({"name": "n", "task": "t", "fps": 1, "columns": columns})
    source = Source(tmp_path / "log.csv", None, tmp_path / "log.csv")
    (block,) = csv.read(source, mapping)
    assert block.values["whole"].tolist() == [2**53 + 1, -2] and block.values["float"].tolist() == [0.5, 1000.0]
    assert block.values["flag"].tolist() == [1.0, 0.0]
    np.testing.assert_array_equal(block.values["gap"], [1.0, np.nan])


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_lines_that_are_empty_are_counted(tmp_path: Path, end: str) -> None:
    path = tmp_path / "log.csv"
    rows = "0,0,0\n\n\nnan,1,0.1\n\n2,2,0.2\n3,3,0.3\n\n4,4,0\n5,5,0.1\n\n6,"
    path.write_bytes(f"\nx,y,t\n\n{rows}".replace("\n", end).encode())
    timed = 'time = "t"\nnot_finite = "drop"\n' + TORN
    _, report = imported(tmp_path, path, timed)
    tally = report.tally
    assert tally.faults == "x in 1 row, log.csv line 7" and tally.back_first == "log.csv line 12"
    assert tally.torn_first == "log.csv line 15"
    path.write_bytes(path.read_bytes().replace(b"nan", b"oops"))
    with pytest.raises(BadInputError, match=r"log\.csv line 7: field 'x': expected numbers, .*, got 'oops'"):
        imported(tmp_path / "again", path, timed)


@pytest.mark.parametrize(
    ("name", "mark", "told"), [("log.csv", ";", "commas, got semicolons"), ("log.tsv", ",", "tabs, got commas")]
)
def test_another_separator_is_told(tmp_path: Path, name: str, mark: str, told: str) -> None:
    log = tmp_path / name
    log.write_text("x;y;command\n1,5;2;3\n".replace(";", mark))
    with pytest.raises(BadInputError, match=rf"{name}: expected fields parted by {told} in its header"):
        imported(tmp_path, log)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"x,y,\xb0\n0,0,0\n1,1,1\n", "log.csv: expected text in UTF-8, got the byte 0xb0: save it as UTF-8"),
        ("x,y\n0,0\n1,1\n".encode("utf-16"), "log.csv: expected text in UTF-8, got UTF-16: save it as UTF-8"),
        (b'x,y\n\n0,0\n1,"1\n\n",2\n2,2\n', "log.csv cannot be read as csv: line 6: Expected 2 columns, got 3: "),
        (b"# today\nx,y\n0,0\n", "line 2: Expected 1 columns, got 2: leave out what is above the header, '# to"),
    ],
)
def test_why_a_file_is_no_csv_is_told(tmp_path: Path, content: bytes, expected: str) -> None:
    (tmp_path / "log.csv").write_bytes(content)
    with pytest.raises(BadInputError, match=re.escape(expected)):
        imported(tmp_path, tmp_path / "log.csv", TORN)


TORN = (
    'name = "log"\ntask = "t"\nfps = 10\n[columns."observation.state"]\nfields = ["x"]\n'
    '[columns.action]\nfields = ["y"]\n'
)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_a_last_line_that_is_cut_off_is_rejected_alone(tmp_path: Path, end: str) -> None:
    """In a file, and in an archive."""
    rows = 3
    whole = f"x,y,z{end}" + "".join(f"{row},{row}.5,0000{end}" for row in range(rows))
    for number, torn in enumerate((f"{rows},", f"{rows}", f"{rows},0,")):
        log = tmp_path / "log.csv"
        log.write_bytes((whole + torn).encode())
        archive = tmp_path / "logs.tar.gz"
        with tarfile.open(archive, "w:gz") as packed:
            packed.add(log, "log.csv")
        for recording in (log, archive):
            dataset, report = imported(tmp_path / f"{number}{recording.suffix}", recording, TORN)
            assert dataset.lengths.tolist() == [rows - 1]
            tally = report.tally
            assert (tally.rows, tally.rejected_rows, tally.torn_rows) == (rows + 1, 1, 1)
            assert tally.torn_first.endswith(f"log.csv line {rows + 2}")
        assert "rejected rows: 1; cut off at the end of their files: 1, the first is " in str(report)
    log.write_bytes(whole.removesuffix(end).encode())
    assert imported(tmp_path / "whole", log, TORN)[1].tally.rejected_rows == 0


def test_a_cut_off_line_begins_a_new_episode_where_files_go_on(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    for name in ("1.csv", "2.csv"):
        (tmp_path / f"logs/{name}").write_text("x,y,z\n1,2,3\n1,2,3\n1,2,3\n1,2")
    for number, (keys, lengths) in enumerate((("refuse", [2, 2]), ("split", [2, 2]), ("drop", [5]))):
        mapping = f'not_finite = "{keys}"\n{TORN}[split]\nfiles = false\n'
        dataset, _ = imported(tmp_path / str(number), tmp_path / "logs", mapping)
        assert dataset.lengths.tolist() == lengths


def joined(folder: Path, prefix: str, *, lost: slice = slice(0)) -> None:
    """Write states at 10 Hz and commands at 20 Hz, 0.3 s later, one twice and without those `lost`; times in ms."""
    folder.mkdir(exist_ok=True)
    states = "".join(f"{100 * k},{k},{-k}\n" for k in range(40))
    commands = [f"{50 * k + 300},{k}\n" for k in sorted([*range(80), 50])]
    del commands[lost]
    (folder / f"{prefix}state.csv").write_text(f"t,x,y\n{states}")
    (folder / f"{prefix}control_state.csv").write_text("t,u\n" + "".join(commands))


JOINED = f"""{LOG}time = "t"
time_scale = 0.001
[columns."observation.state"]
fields = ["state.csv:x", "state.csv:y"]
names = ["x", "y"]
[columns.action]
fields = ["control_state.csv:u"]
[split]
gap_s = 0.15
"""


def test_files_of_one_recording_are_joined_by_time(tmp_path: Path) -> None:
    joined(tmp_path / "logs", "run1_")
    joined(tmp_path / "logs/other", "", lost=slice(20, 30))
    with (tmp_path / "logs/other/state.csv").open("a") as cut_off:
        cut_off.write("4000,4")
    with (tmp_path / "logs/other/control_state.csv").open("a") as cut_off:
        cut_off.write("43")
    dataset, report = imported(tmp_path, tmp_path / "logs", JOINED)
    assert (report.tally.torn_rows, report.tally.torn_first) == (1, "other/state.csv line 42")
    before, after, first = dataset.episodes()
    # The first command comes at 0.3 s, so the first row is that of the same time.
    assert first.columns["observation.state"][:2].tolist() == [[3, -3], [4, -4]]
    assert first.columns["action"].tolist() == [2 * k for k in range(len(first))]
    assert dataset.metadata["source"] == ["other/state.csv", "other/state.csv", "run1_state.csv"]
    # Commands 20 to 29, of 1.3 to 1.75 s, are lost: 1.25 s holds until 1.4, and the next is of 1.8 s.
    assert before.columns["observation.state"][[0, -1], 0].tolist() == [3, 13]
    assert after.columns["observation.state"][0, 0] == 18 and after.columns["action"][:2].tolist() == [30, 32]
    assert len(dataset.description["config"]["recordings"]) == 4
    lost = "left out {} rows without recent enough ones of control_state.csv"
    assert all(lost.format(rows) in str(report) for rows in (3, 6))
    assert "left out the last line of control_state.csv, which is cut off" in str(report)
    _, report = imported(tmp_path / "held", tmp_path / "logs", JOINED.replace("gap_s = 0.15\n", ""))
    assert "rows of control_state.csv, which come every 0.05 s, hold for up to 0.45 s: set split.gap_s" in str(report)
    (state := tmp_path / "logs/run1_state.csv").write_text(state.read_text().replace("\n900,", "\n,"))
    with pytest.raises(BadInputError, match=r"t in 1 row, run1_state\.csv line 11"):
        imported(tmp_path / "again", tmp_path / "logs", JOINED)


def test_files_that_cannot_be_joined_are_refused(tmp_path: Path) -> None:
    joined(tmp_path / "logs", "", lost=slice(20, 30))
    for old, new, told in (
        ('time = "t"\ntime_scale = 0.001\n', "", "files are joined by time: set `time`"),
        ("control_state.csv:u", "u", r"u: expected the file of each field, such as state\.csv:x"),
        ("control_state.csv:u", "wind.csv:u", r"wind\.csv is missing, which is joined with state\.csv"),
        ("control_state.csv:u", "control_state.csv:v", r"control_state\.csv: no field 'v'"),
    ):
        mapping = JOINED.replace(old, new)
        with pytest.raises(BadInputError, match=told):
            imported(tmp_path / "x", tmp_path / "logs", mapping if new else mapping.replace("gap_s = 0.15\n", ""))
    state, control = tmp_path / "logs/state.csv", tmp_path / "logs/control_state.csv"
    state.write_text(state.read_text().replace("\n2000,20,", "\n2000,nan,"))
    with pytest.raises(BadInputError, match=r"state\.csv:x in 1 row, state\.csv line 22"):
        imported(tmp_path / "x", tmp_path / "logs", JOINED)
    control.write_text("t,u\n1.0,1\n0.5,2\n")
    with pytest.raises(BadInputError, match=r"control_state\.csv: 't' goes back or is missing: sort"):
        imported(tmp_path / "x", tmp_path / "logs", JOINED)


@pytest.mark.parametrize(
    "cell", ['"[{0}, -{0}.5, 1e2]"', "[{0} -{0}.5  1e2]", '"({0}; -{0}.5; 100)"', '"[ {0}\n -{0}.5 100]"']
)
def test_a_cell_may_be_a_list(tmp_path: Path, cell: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text("pose,u\n" + "".join(f"{cell.format(k)},{k}\n" for k in range(5)))
    mapping = (
        JOINED.partition("time")[0]
        + '[columns."observation.state"]\nfields = ["pose"]\n[columns.action]\nfields = ["u"]\n'
    )
    dataset, _ = imported(tmp_path, path, mapping)
    assert dataset.columns(["observation.state"])["observation.state"].tolist() == [
        [k, -k - 0.5, 100] for k in range(4)
    ]
    path.write_text(path.read_text() + "[1 2],3\n")
    with pytest.raises(BadInputError, match=r"field 'pose': expected a list of 3 numbers as in .* got '\[1 2\]'"):
        imported(tmp_path / "bad", path, mapping)


def test_a_header_of_numbers_is_none_but_pandas_own(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("0.0,1,-2e3\n0.1,2,nan\n")
    told = r"expected a header with a name for each field, got numbers: .* such as f0,f1,f2 \(sed"
    with pytest.raises(BadInputError, match=told):
        imported(tmp_path, path)
    path.write_text("0,1\n5,6\n7,8\n")
    mapping = JOINED.partition("time")[0] + '[columns."observation.state"]\nfields = ["1"]\n'
    dataset, _ = imported(tmp_path, path, mapping)
    assert dataset.columns(["observation.state"])["observation.state"].tolist() == [6]
