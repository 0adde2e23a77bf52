from typing import Any

from astra_data.reports.blocks import TableBlock
from astra_data.reports.page import sections_of
from astra_data.reports.results import TESTED, Line, Results

ROW, INITIAL = "direct_transfer_iql", "direct_transfer"


def test_what_a_method_costs_includes_the_training_that_it_starts_from() -> None:
    lines = [Line(row=ROW, seed=0, where=TESTED, values={"success": 0.5})]
    lines += [Line(row=row, seed=0, where="train", values={"wall_seconds": 30.0}) for row in (ROW, INITIAL)]
    facts: dict[str, Any] = {"recipe": "r", "task": "t", "command": "c", "rows": (ROW,), "episodes": 4}
    sections = sections_of(Results(**facts, lines=lines), "runs/r")
    tables = [block for section in sections for block in section.blocks if isinstance(block, TableBlock)]
    (costs,) = (table for table in tables if table.title.startswith("Time for one seed"))
    assert dict(zip(costs.head, costs.lines[0], strict=True))["train"] == "60 s"
