from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_cart import LOGS_ALONE

from astra_data import Column
from astra_data.core.errors import BadInputError
from astra_data.pipeline.selecting import Sheet

TASK = replace(LOGS_ALONE, goal=Column("goal", size=1, names=("goal_x",), astra={"unit": ["m"]}))
POLICIES = [("nas", 3), ("astra", 0)]
HEADER = "round,trial,policy,start_x,goal_x_m,result\n"


def sheet(folder: Path, *, goals: tuple[float, ...] = (1.5, 1.23456)) -> Sheet:
    made = Sheet(folder / "trials.csv", TASK)
    made.plan(0, POLICIES, np.array([[-0.0], [0.25]]), np.array(goals)[:, None])
    return made


def pressing(keys: str, shown: list[str]) -> Callable[[str], str]:
    left = iter(keys)

    def ask(what: str) -> str:
        shown.append(what)
        return next(left)

    return ask


def test_each_start_is_run_by_every_policy_before_the_next(tmp_path: Path) -> None:
    made = sheet(tmp_path)
    made.plan(1, POLICIES[:1], np.array([[1.0]]), np.array([[2.0]]))
    made.write()
    lines = "1,1,nas/seed_3,0,1.5,\n1,2,astra/seed_0,0,1.5,\n1,3,nas/seed_3,0.25,1.235,\n1,4,astra/seed_0,0.25,1.235,\n"
    assert (tmp_path / "trials.csv").read_text() == f"{HEADER}{lines}2,1,nas/seed_3,1,2,\n"


def test_keys_fill_the_sheet_and_a_void_trial_is_repeated(tmp_path: Path) -> None:
    made, shown = sheet(tmp_path), list[str]()
    assert not made.fill(0, pressing("sv?vfq", shown), lambda: f"{len(shown)} shown")
    assert shown[0] == "0 shown\nround 1, trial 1 of 4: run nas/seed_3 for 4 s, start_x 0, goal_x_m 1.5"
    assert shown[2].endswith("trial 2 of 4, again, as it was void: run astra/seed_0 for 4 s, start_x 0, goal_x_m 1.5")
    assert [text.split(" of ")[0][-1] for text in shown] == list("122223")
    text = (tmp_path / "trials.csv").read_text()
    voids = "1,2,astra/seed_0,0,1.5,void\n" * 2
    assert f"1,1,nas/seed_3,0,1.5,success\n{voids}1,2,astra/seed_0,0,1.5,failure\n1,3" in text
    again = sheet(tmp_path)
    again.read()
    again.write()
    assert (tmp_path / "trials.csv").read_text() == text and again.results == made.results
    assert again.counted(0, ("nas", 3), [0.1, 0.2]) == ([1], [0.1])
    assert again.counted(0, ("astra", 0), [0.3, 0.4]) == ([0], [0.3])
    assert again.fill(0, pressing("sf", shown), str)
    assert again.counted(0, ("astra", 0), [0.3, 0.4]) == ([0, 0], [0.3, 0.4])
    assert again.fill(0, pressing("", shown), str)


def test_what_was_filled_in_meanwhile_is_kept(tmp_path: Path) -> None:
    made = sheet(tmp_path)
    made.write()
    path = tmp_path / "trials.csv"

    def ask(what: str) -> str:
        if "trial 1 " in what:
            path.write_text(path.read_text().replace("1,4,astra/seed_0,0.25,1.235,", "1,4,astra/seed_0,0.25,1.235,f"))
        return "s"

    assert made.fill(0, ask, str) and [*made.results.values()] == [["success"]] * 3 + [["failure"]]


def test_a_sheet_of_a_spreadsheet_is_understood(tmp_path: Path) -> None:
    made = sheet(tmp_path)
    lines = [
        '1,3,nas/seed_3,0.25000,1.2350,"Success "',
        ",,,,,",
        "1,1,nas/seed_3,0.0,1.50,S",
        "1,1,nas/seed_3,0,1.5,VOID",
    ]
    (tmp_path / "trials.csv").write_bytes(("\ufeff" + HEADER + "\n".join(lines)).replace("\n", "\r\n").encode())
    made.read()
    assert [*made.results.values()] == [["success", "void"], [], ["success"], []]
    made.write()
    rows = (tmp_path / "trials.csv").read_text().splitlines()
    assert [row.rpartition(",")[2] for row in rows[1:]] == ["void", "success", "", "success", ""]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("1,1,nas/seed_3,0,1.5,perhaps", "line 2: expected success, failure, void or nothing as result, found perhaps"),
        ("1,1,nas/seed_3,0,1.5", "line 2: expected 6 cells, found 5"),
        ("1,5,nas/seed_3,0,1.5,s", "line 2: expected round, trial and policy as planned, found 1,5,nas/seed_3"),
        ("1,1,astra/seed_0,0,1.5,s", "line 2: expected round, trial and policy as planned, found 1,1,astra/seed_0"),
        ("1,1,nas/seed_3,0.5,1.5,s", "line 2: expected start_x 0, found 0.5"),
        ("1,1,nas/seed_3,0,,s", "line 2: expected goal_x_m 1.5, found nothing"),
        (
            "1,1,nas/seed_3,0,1.5,f\n1,1,nas/seed_3,0,1.5,s",
            "line 3: expected one result of trial 1 of round 1, found a",
        ),
    ],
)
def test_a_malformed_line_is_named_and_nothing_is_taken(tmp_path: Path, line: str, expected: str) -> None:
    made, path = sheet(tmp_path), tmp_path / "trials.csv"
    path.write_text(f"{HEADER}{line}\n1,2,astra/seed_0,0,1.5,s\n")
    before = path.read_bytes()
    with pytest.raises(BadInputError) as refused:
        made.read()
    assert f"{path}, {expected}" in str(refused.value) and "remove the line for a new one" in str(refused.value)
    assert not any(made.results.values()) and path.read_bytes() == before


@pytest.mark.parametrize("content", [b"", b"round;trial\n", b"\xff\xfe\x00", b'round,"trial\n', b"a,b\n1,\x00\n"])
def test_what_is_no_sheet_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "trials.csv").write_bytes(content)
    with pytest.raises(BadInputError, match=r"trials.csv.*expected .*, found .*: "):
        sheet(tmp_path).read()
    (tmp_path / "trials.csv").unlink()
    with pytest.raises(BadInputError, match=r"expected the sheet of the trials, found .*No such file"):
        sheet(tmp_path).read()
