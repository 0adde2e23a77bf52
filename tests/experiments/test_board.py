from io import StringIO

import pytest
from rich.console import Console

from astra_data.experiments.board import Board
from astra_data.experiments.local_executor import Item
from astra_data.experiments.points import RunPoint
from astra_data.worlds.score import SUCCESS, SURVIVED_STEPS


def items(*points: RunPoint) -> list[Item]:
    made = [Item("pair/seed_0", (), print)]
    for point in points:
        train = point.key.replace("evaluate", "train")
        made += [Item(train, ("pair/seed_0",), print), Item(point.key, (train,), print)]
    return made


def drawn(board: Board) -> str:
    file = StringIO()
    Console(file=file, width=80).print(board)
    return file.getvalue()


def test_a_point_is_at_the_last_stage_that_works_for_it() -> None:
    nas, astra = RunPoint("nas", 0), RunPoint("astra", 0)
    planned = items(nas, astra)
    board = Board([nas, astra], planned, SUCCESS, {}, [item.key for item in planned])
    assert board.state(nas) == "waiting"
    board.started("pair/seed_0")
    board.progressed("pair/seed_0", 0.5)
    assert (board.state(nas), board.state(astra)) == ("pairing 50 %", "pairing 50 %")
    board.finished("pair/seed_0", 1.0)
    board.started("train/nas/seed_0")
    board.progressed("train/nas/seed_0", 0.43)
    assert (board.state(nas), board.state(astra)) == ("training 43 %", "waiting")
    board.failed("train/nas/seed_0")
    assert (board.state(nas), board.state(astra)) == ("failed", "waiting")
    board.done(astra, 0.72)
    assert board.state(astra) == "done 0.72"
    shown = drawn(board)
    assert "seed 0" in shown and "done 0.72" in shown and "failed" in shown


def test_with_sizes_a_cell_tells_of_all_seeds() -> None:
    points = [RunPoint("nas", seed, percent) for percent in (25, 50) for seed in (0, 1, 2)]
    planned = items(*points)
    success = {points[0]: 0.5, points[1]: 0.7}
    board = Board(points, planned, SUCCESS, success, [point.key for point in points[2:]])
    board.started("evaluate/nas/percent_025/seed_2")
    shown = drawn(board)
    assert "2 of 6 points" in shown
    assert "2 of 3 done 0.60" in shown and "evaluating 0 %" in shown
    assert "0 of 3 done" in shown
    steps = Board(points, planned, SURVIVED_STEPS, {points[0]: 62.6, points[1]: 70.0}, [])
    assert steps.state(points[0]) == "done 63"
    assert "2 of 3 done 66" in drawn(steps)


def test_the_time_left_follows_from_the_work_done_and_its_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("astra_data.experiments.board.time.monotonic", lambda: now)
    points = [RunPoint("nas", seed) for seed in range(4)]
    planned = items(*points)[1:]
    board = Board(
        points, [Item("pair/seed_0", (), print), *planned], SUCCESS, {}, [item.key for item in planned]
    )
    assert board.whole() == "0 of 4 points"
    # Two at a time: 4 trainings of 1000 s and 4 evaluations of 200 s take 40 min; a quarter is done.
    for seed in (0, 1):
        board.started(f"train/nas/seed_{seed}")
    now = 1000.0
    for seed in (0, 1):
        board.finished(f"train/nas/seed_{seed}", 1000.0)
        board.started(f"evaluate/nas/seed_{seed}")
    assert board.whole() == "0 of 4 points"
    now = 1200.0
    for seed in (0, 1):
        board.finished(f"evaluate/nas/seed_{seed}", 200.0)
        board.done(points[seed], 1.0)
    assert board.whole() == "2 of 4 points, 20 min left"
    for seed in (2, 3):
        board.started(f"train/nas/seed_{seed}")
    now = 1700.0
    for seed in (2, 3):
        board.progressed(f"train/nas/seed_{seed}", 0.5)
    assert board.whole() == "2 of 4 points, 12 min left"


def test_an_item_may_fail_before_it_has_begun() -> None:
    nas = RunPoint("nas", 0)
    planned = items(nas)
    board = Board([nas], planned, SUCCESS, {}, [item.key for item in planned])
    board.failed("pair/seed_0")
    assert board.state(nas) == "failed"
