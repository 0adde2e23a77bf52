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


def test_what_is_compared_may_be_named_with_or_without_the_plus_settings() -> None:
    found = [line(row, seed, success=0.5) for row in ("nas_plus", "astra_plus") for seed in range(3)]
    for name in ("astra", "astra_plus"):
        (methods,) = (one for one in sections_of(results(*found, compare=(name,)), "r") if one.title == "Methods")
        titles = [block.title for block in methods.blocks if isinstance(block, TableBlock) and block.lines]
        assert "Probability of improvement" in titles


def test_seeds_stand_in_the_order_of_rows_with_a_dash_for_what_they_lack() -> None:
    lines = line("nas", 1, success=0.0), line("astra", 0, success=0.5, distance=2.0)
    found = results(*lines, rows=("astra", "nas"))
    (every,) = (one.blocks[0] for one in sections_of(found, "r") if one.title == "Every seed")
    assert isinstance(every, TableBlock) and every.head == ["method", "seed", "success", "distance"]
    assert every.lines == [["ASTRA", "0", "0.5", "2"], ["NAS", "1", "0", "-"]]


def test_names_are_explained_of_methods_that_there_are() -> None:
    assert WORDS.keys() <= METHODS.keys()
