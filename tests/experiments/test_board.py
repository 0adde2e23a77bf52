from io import StringIO

from rich.console import Console

from astra_data.experiments.board import board, progress_text
from astra_data.experiments.points import RunPoint
from astra_data.worlds.score import SUCCESS, SURVIVED_STEPS, Score


def shown(points: list[RunPoint], means: dict[RunPoint, float], score: Score = SUCCESS) -> str:
    """Return the table as the terminal shows it."""
    file = StringIO()
    Console(file=file, width=100).print(board(points, means, score))
    return file.getvalue()


def drawn(points: list[RunPoint], means: dict[RunPoint, float], score: Score = SUCCESS) -> list[list[str]]:
    """Return the cells of the table, row by row."""
    lines = [line for line in shown(points, means, score).splitlines() if "│" in line or "┃" in line]
    return [[cell.strip() for cell in line.replace("┃", "│").split("│")[1:-1]] for line in lines]


def test_without_sizes_there_is_a_column_for_each_seed() -> None:
    points = [RunPoint(method, seed) for method in ("nas", "astra") for seed in (0, 1)]
    head, *rows = drawn(points, {points[0]: 0.714, points[3]: 1.0})
    assert head == ["method", "seed 0", "seed 1"]
    assert rows == [["NAS", "done 0.71", ""], ["ASTRA", "", "done 1.00"]]


def test_with_sizes_a_cell_counts_its_seeds_and_shows_their_mean() -> None:
    points = [RunPoint("nas", seed, percent) for percent in (25, 50) for seed in (0, 1, 2)]
    head, row = drawn(points, {points[0]: 0.5, points[1]: 0.7})
    assert head[1:] == ["25 %", "50 %"]
    assert row[1:] == ["2 of 3 done 0.60", "0 of 3 done"]
    assert drawn(points, {points[0]: 62.6, points[1]: 70.0}, SURVIVED_STEPS)[1][1] == "2 of 3 done 66"


def test_one_size_of_one_seed_is_a_point_of_its_own() -> None:
    points = [RunPoint("nas", 3, 50)]
    assert drawn(points, {points[0]: 0.25})[1][1:] == ["done 0.25"]


def test_a_size_on_which_a_row_is_not_asked_for_is_left_empty() -> None:
    points = [RunPoint("nas", seed, percent) for percent in (25, 50) for seed in (0, 1)]
    points += [RunPoint("astra", seed, 50) for seed in (0, 1)]
    assert [row[1:] for row in drawn(points, {})[1:]] == [["0 of 2 done"] * 2, ["", "0 of 2 done"]]


def test_the_title_counts_what_is_finished() -> None:
    points = [RunPoint("nas", seed) for seed in range(3)]
    assert shown(points, {points[2]: 0.5}).startswith("1 of 3 points")


def test_only_the_points_that_are_shown_are_counted() -> None:
    points = [RunPoint("nas", seed) for seed in range(3)]
    means = {points[1]: 0.5, RunPoint("astra", 0): 0.5}
    assert progress_text(points, means) == "1 of 3 points"


def test_one_size_of_several_seeds_has_a_column_for_each_seed() -> None:
    points = [RunPoint("nas", seed, 50) for seed in (0, 1)]
    assert drawn(points, {points[1]: 0.5}) == [["method", "seed 0", "seed 1"], ["NAS", "", "done 0.50"]]
