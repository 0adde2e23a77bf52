import re
from io import StringIO

import pytest
from rich.console import Console

from astra_data.core.errors import AstraDataError
from astra_data.pipeline.display import display, shown


def test_without_a_terminal_there_are_plain_lines() -> None:
    file = StringIO()
    with display(["collect/seed_0", "pair/seed_0"], Console(file=file, width=20)) as watch:
        watch("collect/seed_0", None)
        for percent in (1, 11, 12, 35):
            watch("collect/seed_0", (percent / 100, "8 k steps/s [x]"))
        watch("collect/seed_0", 1.26)
    assert file.getvalue().splitlines() == [
        "collect/seed_0  started",
        "collect/seed_0  10 %  8 k steps/s [x]",
        "collect/seed_0  30 %  8 k steps/s [x]",
        "collect/seed_0  finished in 1.3 s  (1 of 2)",
    ]


def test_in_a_terminal_finished_items_become_lines_above_the_running_ones() -> None:
    file = StringIO()
    keys = ["train/nas/seed_0", "train/nas/seed_1"]
    with display(keys, Console(file=file, width=120, force_terminal=True, no_color=True)) as watch:
        watch("train/nas/seed_0", None)
        watch("train/nas/seed_0", (0.5, "success 0.83"))
        watch("train/nas/seed_0", 3.0)
        watch("train/nas/seed_1", None)
        watch("train/nas/seed_1", (0.25, "success 0.84 [x]"))
    assert "train/nas/seed_0  finished in 3.0 s" in file.getvalue()
    whole, running = file.getvalue().rpartition("1 of 2 finished")[2].splitlines()[:2]
    assert "62%" in whole and "train/nas/seed_1" in running and "25%" in running and "success 0.84 [x]" in running


def test_in_80_columns_bar_share_and_time_left_stay() -> None:
    file, key = StringIO(), "train/direct_transfer_task_reward_plus/percent_100/seed_0"
    note = "31 k steps/s  success 0.83  return 12.1  made of very many words"
    with display([key], Console(file=file, width=80, force_terminal=True, no_color=True)) as watch:
        watch(key, None)
        watch(key, (0.5, note))
    *_, line = (line for line in file.getvalue().splitlines() if "train/direct" in line)
    assert len(line.rstrip()) <= 80 and re.search(r"train/direct\S*… .*━{9}.* 50% -:--:-- 31 k.*…", line)


@pytest.mark.parametrize("is_terminal", [False, True])
def test_an_item_may_fail_before_it_has_begun(is_terminal: bool) -> None:
    console = Console(file=StringIO(), force_terminal=is_terminal)
    with display(["train/nas/seed_0"], console) as watch:
        watch("train/nas/seed_0", AstraDataError())


def test_one_job_is_shown_on_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    with shown("push") as progress:
        progress(0.5, "3 of 6 files")
    told = capsys.readouterr()
    assert told.out == ""
    *lines, last = told.err.splitlines()
    assert lines == ["push  started", "push  50 %  3 of 6 files"]
    assert last.startswith("push  finished in 0.") and last.endswith(" s  (1 of 1)")
