from pathlib import Path

from astra_data.io.cutting import Tally
from astra_data.io.importing import ImportReport, losses


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
