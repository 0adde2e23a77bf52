from pathlib import Path

from astra_data.io.import_report import ImportReport, Tally, losses


def test_what_was_dropped_is_counted_aloud() -> None:
    tally = Tally(rows=9, split_points={"file": 1}, last_rows=2, last_terminated=1, last_reward=1.5)
    assert losses(tally) == (
        "rows 9, rejected 0, last ones without a next state 2 dropped (1 of them terminated: the step "
        "before takes over how, and the reward, with the others a reward of 1.5 in sum), in episodes that "
        "were too short 0"
    )
    assert "next state 0 dropped, in" in losses(Tally())
    report = str(ImportReport(Path("out"), 2, 7, tally, 0.25))
    assert report.startswith("out: 2 episodes, 7 frames from 9 rows in 0.2 s\nsplit points: file 1\n")


def test_the_recorded_rate_is_told_where_there_is_one() -> None:
    tally = Tally(
        rows=9, clock="10 Hz declared, 9.9 Hz by t; gaps within episodes: 1, jitter 4.0 % of a period"
    )
    assert f"\nrate: {tally.clock}\nrejected rows" in str(ImportReport(Path("out"), 2, 7, tally, 0.25))
    assert "rate" not in str(ImportReport(Path("out"), 2, 7, Tally(rows=9), 0.25))


def test_rows_after_the_end_are_told_where_there_are_any() -> None:
    told = "; terminated rows after the end, dropped: 4"
    tally = Tally(rows=9, rows_after_end=4)
    assert losses(tally).endswith(told)
    assert str(ImportReport(Path("out"), 2, 7, tally, 0.25)).endswith(told)
    assert "after the end" not in losses(Tally(rows=9))


def test_time_that_stands_still_is_told_with_its_place() -> None:
    tally = Tally(rows=9, still_rows=4, still_first="a.csv line 3")
    told = str(ImportReport(Path("out"), 2, 7, tally, 0.25))
    assert "\ntime stands still in 4 rows, first in a.csv line 3: expected one row at a time" in told
    assert "still" not in str(ImportReport(Path("out"), 2, 7, Tally(rows=9), 0.25))


def test_files_that_were_not_read_are_told_shortly() -> None:
    unread = tuple(f"{number}.txt" for number in range(10))
    told = str(ImportReport(Path("out"), 2, 7, Tally(), 0.25, ("a.csv",), unread))
    listed = ", ".join(unread[:8])
    assert (
        f"\nfiles without an episode: a.csv\nfiles of other endings, not read: {listed} and 2 more\nrej"
        in told
    )
    assert "not read" not in str(ImportReport(Path("out"), 2, 7, Tally(), 0.25))


def test_strange_rates_are_told_in_lines_of_their_own_and_shortly() -> None:
    notes = [f"{number}.csv: 40 Hz, 20 Hz declared" for number in range(10)]
    told = str(ImportReport(Path("out"), 2, 7, Tally(notes=notes[:8]), 0.25))
    assert "\n".join(["", *notes[:8], "rejected"]) in told
    told = str(ImportReport(Path("out"), 2, 7, Tally(notes=notes), 0.25))
    assert "\n".join(["", *notes[:8], "and 2 more lines on rates", "rejected"]) in told


def test_what_is_strange_about_topics_of_several_files_is_told_once() -> None:
    tally = Tally(topics={"/odom is late": ["0.mcap"], "/odom is slow": [f"{k}.mcap" for k in range(9)]})
    tally.notes += ["0.csv: 40 Hz, 20 Hz declared"]
    lines = [
        "",
        "0.mcap: /odom is late",
        "0.mcap, 1.mcap and 7 more: /odom is slow",
        *tally.notes,
        "rejected",
    ]
    assert "\n".join(lines) in str(ImportReport(Path("out"), 2, 7, tally, 0.25))
