from fake_runs import line, results

from astra_data.methods import METHODS
from astra_data.reports.blocks import TableBlock
from astra_data.reports.page import WORDS, sections_of

ROW, INITIAL = "direct_transfer_iql", "direct_transfer"


def test_what_a_method_costs_includes_the_training_that_it_starts_from() -> None:
    trainings = [line(row, 0, "train", wall_seconds=30.0) for row in (ROW, INITIAL)]
    sections = sections_of(results(line(ROW, 0, success=0.5), *trainings, rows=(ROW,)), "runs/r")
    tables = [block for section in sections for block in section.blocks if isinstance(block, TableBlock)]
    (costs,) = (table for table in tables if table.title.startswith("Time for one seed"))
    assert dict(zip(costs.head, costs.lines[0], strict=True))["train"] == "60 s"


def test_names_are_explained_of_methods_that_there_are() -> None:
    assert WORDS.keys() <= METHODS.keys()
