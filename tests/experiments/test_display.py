from io import StringIO

import pytest
from rich.console import Console

from astra_data.experiments.display import display, shown


def test_without_a_terminal_there_are_plain_lines() -> None:
    file = StringIO()
    with display(2, Console(file=file, width=20)) as watch:
        watch.started("collect/seed_0")
        for percent in (1, 11, 12, 35):
            watch.progressed("collect/seed_0", percent / 100, "8 k steps/s [x]")
        watch.finished("collect/seed_0", 1.26)
    assert file.getvalue().splitlines() == [
        "collect/seed_0  started",
        "collect/seed_0  10 %  8 k steps/s [x]",
        "collect/seed_0  30 %  8 k steps/s [x]",
        "collect/seed_0  finished in 1.3 s  (1 of 2)",
    ]


def test_in_a_terminal_finished_items_become_lines_above_the_running_ones() -> None:
    file = StringIO()
    with display(2, Console(file=file, width=120, force_terminal=True, no_color=True)) as watch:
        watch.started("train/nas/seed_0")
        watch.progressed("train/nas/seed_0", 0.5, "success 0.83")
        watch.finished("train/nas/seed_0", 3.0)
        watch.started("train/nas/seed_1")
        watch.progressed("train/nas/seed_1", 0.25, "success 0.84 [x]")
    assert "train/nas/seed_0  finished in 3.0 s" in file.getvalue()
    whole, running = file.getvalue().rpartition("1 of 2 finished")[2].splitlines()[:2]
    assert "50%" in whole
    assert "train/nas/seed_1" in running and "25%" in running and "success 0.84 [x]" in running


def test_in_a_terminal_something_may_stand_above_the_items() -> None:
    file = StringIO()
    terminal = Console(file=file, width=120, force_terminal=True, no_color=True)
    with display(2, terminal, above="all points") as watch:
        watch.started("train/nas/seed_0")
        watch.failed("train/nas/seed_0")
    _, above, last = file.getvalue().rpartition("all points")
    assert above and "train/nas/seed_0" in last and "failed" in last


@pytest.mark.parametrize("is_terminal", [False, True])
def test_an_item_may_fail_before_it_has_begun(is_terminal: bool) -> None:
    console = Console(file=StringIO(), force_terminal=is_terminal)
    with display(1, console) as watch:
        watch.failed("train/nas/seed_0")


def test_one_job_is_shown_on_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    with shown("push") as progress:
        progress(0.5, "3 of 6 files")
    told = capsys.readouterr()
    assert told.out == ""
    *lines, last = told.err.splitlines()
    assert lines == ["push  started", "push  50 %  3 of 6 files"]
    assert last.startswith("push  finished in 0.") and last.endswith(" s  (1 of 1)")
