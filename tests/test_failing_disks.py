"""A sample of what tools/try_failing_disks.py tries, and the disk that fails in it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from disks.failing_disk import FAILURES, Kind, Operation, why_not
from disks.lost_power import OUTCOMES, Memory, Outcome

TOOLS = Path(__file__).parents[1] / "tools"
COMMANDS = ("subset",)
FAULTLESS = {"command", "failure", "tried"}

WRITES = """
import os, sys, tempfile
from pathlib import Path
import h5py, pyarrow as pa, pyarrow.parquet as pq, numpy as np
from disks.failing_disk import COUNTING, FAILURES, FailingDisk, read_journal, start_over
from disks.lost_power import Memory

start_over(lambda: Path(sys.argv[1]))
watched, twin = Path(sys.argv[1], "watched"), Path(sys.argv[1], "twin")
watched.mkdir(), twin.mkdir()
disk, memory = FailingDisk(watched), Memory(watched)
disk.arm(COUNTING, journal=Path(sys.argv[1], "journal"))
pq.write_table(pa.table({"x": range(1000)}), watched / "table.parquet")
with h5py.File(watched / "file.h5", "w") as file:
    file["x"] = np.arange(1000)
(watched / "folder").mkdir()
os.replace(watched / "file.h5", watched / "folder/moved.h5")
print(disk.disarm() > 10)
memory.replay(read_journal(Path(sys.argv[1], "journal")))
memory.write(twin, None)
paths = sorted(path.relative_to(watched) for path in watched.rglob("*") if path.is_file())
print(*paths, *((watched / path).read_bytes() == (twin / path).read_bytes() for path in paths))

def attempt(failure, at):
    disk.arm(FAILURES[failure], at)
    try:
        for _ in range(2):
            with open(watched / "text", "wb", buffering=0) as file:
                print(file.write(b"12345678"), end=" ")
    except OSError as error:
        print(os.strerror(error.errno), end=" ")
    disk.disarm()
    print((watched / "text").read_bytes())

attempt("full", 2)
attempt("full once", 2)
attempt("gone", 4)
attempt("read-only", 1)
sys.stdout.flush()
os.setpgid(0, 0)
attempt("torn write", 1)
"""

pytestmark = pytest.mark.skipif(why_not() is not None, reason=why_not() or "")


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(TOOLS), "ASTRA_DATA_NO_FSYNC": ""}
    return subprocess.run([sys.executable, *command], capture_output=True, text=True, check=False, env=environment)


def test_commands_on_failing_disks_publish_nothing_wrong_and_go_on(tmp_path: Path) -> None:
    figures = tmp_path / "figures.json"
    options = ["--count", "1", "--seed", "1", "--commands", ",".join(COMMANDS), "--json", str(figures)]
    done = run(TOOLS / "try_failing_disks.py", *options)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(figures.read_text())
    trials = found["trials"]
    assert found["operations"].keys() == set(COMMANDS) and min(found["operations"].values()) > 40
    assert len(trials) == len(COMMANDS) * (len(FAILURES) + len(OUTCOMES))
    assert all(trial["tried"] == 1 and trial.keys() == FAULTLESS for trial in trials)


def test_the_disk_fails_when_told_and_sees_every_write(tmp_path: Path) -> None:
    script = tmp_path / "writes.py"
    script.write_text(WRITES)
    done = run(script, tmp_path)
    assert done.returncode == -9, done.stderr
    assert done.stdout.splitlines() == [
        "True",
        "folder/moved.h5 table.parquet True True",
        "4 No space left on device b'1234'",
        "No space left on device b''",
        "8 Input/output error b''",
        "Read-only file system b''",
    ]
    assert (tmp_path / "watched/text").read_bytes() == b"1234"


@pytest.mark.parametrize(
    ("outcome", "kept"),
    [
        ("all lost", {"old": "old", "synced": "12"}),
        ("emptied", {"new": "old", "synced": "12", "unnamed": "1", "unsynced": ""}),
        ("zeroed", {"new": "old", "synced": "12\0", "unnamed": "1", "unsynced": "\0\0"}),
    ],
)
def test_a_power_failure_takes_what_was_not_synced(tmp_path: Path, outcome: Outcome, kept: dict[str, str]) -> None:
    root = tmp_path / "disk"
    root.mkdir()
    (root / "old").write_text("old")
    memory = Memory(root)

    def do(kind: Kind, name: str, other: str = "", offset: int = 0, data: bytes = b"") -> None:
        memory.replay([Operation(kind, str(root / name), other and str(root / other), offset, data)])

    do(Kind.OPEN, "synced")
    do(Kind.WRITE, "synced", data=b"12")
    do(Kind.SYNC, "synced")
    do(Kind.SYNC, "")
    do(Kind.WRITE, "synced", offset=2, data=b"3")
    do(Kind.OPEN, "unnamed")
    do(Kind.WRITE, "unnamed", data=b"1")
    do(Kind.SYNC, "unnamed")
    do(Kind.OPEN, "unsynced")
    do(Kind.WRITE, "unsynced", data=b"12")
    do(Kind.RENAME, "old", "new")
    (tmp_path / "after").mkdir()
    memory.write(tmp_path / "after", outcome)
    assert {path.name: path.read_text() for path in (tmp_path / "after").iterdir()} == kept
