from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from astra_data.cli.inspection_page import inspection_page, shaded
from astra_data.dataset.checkup import Checkup, Finding
from astra_data.dataset.columns import Column
from astra_data.dataset.inspection import BINS, Endings, Inspection, Map, Spread

NOTHING = Checkup(("endings: 3 cut", "rate: 20 Hz declared"), ())


def test_findings_stand_below_all_else() -> None:
    findings = (Finding("warning", "a [gap] of 3 s", "begin there", (4, 9)), Finding("note", "constant: x", "check it"))
    file = StringIO()
    checkup = replace(NOTHING, findings=findings)
    Console(file=file, width=120).print(inspection_page(inspection(success=1), checkup))
    lines = file.getvalue().splitlines()
    assert lines[lines.index("█") + 1 :] == [
        "check-up",
        "endings: 3 cut",
        "rate: 20 Hz declared",
        "warning: a [gap] of 3 s (episodes 4, 9): begin there",
        "note: constant: x: check it",
    ]


def inspection(success: int | None) -> Inspection:
    column = Column("action", size=2, names=("vx", "vy"), astra={"unit": ["m/s", "m/s"]})
    counts = np.zeros((2, BINS), np.int64)
    spread = Spread(column, low=np.array([-1.0, 0.0]), high=np.array([1.0, 0.123456]), mean=np.zeros(2), counts=counts)
    return Inspection(
        reference="fake@data-1.0.0",
        lengths=np.array([600, 1200, 1800]),
        fps=20,
        cameras={"front": [48, 64, 3]},
        success=success,
        endings=Endings(terminated=2, cut_off=1, made_up=1),
        spreads=(spread,),
        positions=Map(np.array([[1, 0], [0, 0]]), np.array([-1.0, 2.0]), 0.5),
        velocities=None,
    )


@pytest.mark.parametrize("success", [None, 1])
def test_a_page_sums_up_the_dataset(success: int | None) -> None:
    file = StringIO()
    Console(file=file, width=120).print(inspection_page(inspection(success), NOTHING))
    lines = file.getvalue().splitlines()
    assert lines[0] == "fake@data-1.0.0: 3 episodes, 3,600 steps, 3.0 min"
    assert lines[1].startswith("lengths 600 to 1800, median 1200  ")
    assert lines[2] == "camera front: 48x64x3"
    assert ("success 1 of 3 episodes (0.33)" in lines) == (success is not None)
    assert any(line.startswith("episodes end: 2 terminated, 1 cut off; 1 next states of") for line in lines)
    table = lines[lines.index("action (2) float32") + 1 :]
    assert table[0].split() == ["value", "unit", "min", "mean", "max", "spread"]
    assert table[1].split() == ["vx", "m/s", "-1", "0", "1"] and table[2].split() == ["vy", "m/s", "0", "0", "0.1235"]
    assert table[3] == "positions, x -1.0 to 0.0 m, y 2.0 to 3.0 m" and table[4] == "█"
    assert table[5:8] == ["check-up", "endings: 3 cut", "rate: 20 Hz declared"]
    assert table[8:] == ["nothing looks wrong in the values; `astra-data validate` also checks all files"]


def test_a_map_begins_at_its_top_and_is_dark_where_the_robot_often_was() -> None:
    counts = np.array([[0, 0], [0, 4], [1, 0]])  # from below, two in a line
    assert shaded(Map(counts, np.zeros(2), 0.5)) == "▒\n █"
