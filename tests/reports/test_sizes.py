from fake_runs import bare_results

from astra_data.reports.choice import Candidate, Judged, choice_of
from astra_data.reports.comparing import summarized
from astra_data.reports.schema import Results
from astra_data.reports.sizes import SizeResults, SizesResults, by_size, render_sizes


def results(success: list[float]) -> Results:
    bare = bare_results("toy", {"astra": [0, 1]}, {})
    row = summarized(bare.methods["astra"].model_copy(update={"success": success}), 100)
    times = {"collect": 100.0, "pair": 60.0, "train": 50.0, "total": 210.0}
    return bare.model_copy(update={"methods": {"astra": row}, "wall_seconds": times, "seeds": [0, 1]})


SMALL, LARGE = results([0.25, 0.5]), results([0.5, 1.0])
FOUND = SizesResults(
    recipe="toy",
    task="maze",
    command="run it",
    sizes=[SizeResults(percent=50, results=SMALL), SizeResults(percent=100, results=LARGE)],
)


def test_results_are_found_by_their_size() -> None:
    assert by_size(FOUND) == {50: SMALL, 100: LARGE}
    assert by_size(SMALL) == {None: SMALL}


def test_the_table_has_a_column_for_each_size() -> None:
    page = render_sizes(FOUND, {})
    assert "# toy\n\nTask `maze`, seeds 0, 1, 1 episodes per row, size and seed." in page
    assert "| method | 50 % | 100 % |" in page
    assert "| astra | 0.38 ± 0.18 | 0.75 ± 0.35 |" in page
    assert "| astra | 0.38 [0.25, 0.50] | 0.75 [0.50, 1.00] |" in page
    assert "## Success by size of the dataset" in page
    assert "Data efficiency" not in page


def test_rows_that_are_not_finished_are_left_open() -> None:
    nas = bare_results("toy", {"nas": [0, 1], "iql": [0, 1, 2], "astra": [1]}, {})
    rows = {name: summarized(row, 100) for name, row in nas.methods.items()}
    found = SizesResults(
        recipe="toy",
        task="maze",
        command="run it",
        sizes=[
            SizeResults(percent=50, results=SMALL.model_copy(update={"unfinished": ["NAS", "DT"]})),
            SizeResults(percent=100, results=nas.model_copy(update={"methods": rows, "seeds": [0, 1]})),
        ],
        unfinished=[10, 150],
    )
    assert found.methods() == ["nas", "iql", "astra"]  # as in the size that has most of them
    page = render_sizes(found, {})
    assert "Not finished yet: NAS and DT at 50 %; all rows at 10 %; all rows at 150 %. Produced by" in page
    assert "| astra | 0.38 ± 0.18 | 0.00 (1 seed) |" in page and "| nas | - | 0.00 ± 0.00 |" in page
    assert "| iql | - | 0.00 ± 0.00 (3 seeds) |" in page
    assert "| astra | 0.38 [0.25, 0.50] | 0.00 |" in page and "| nas | - | 0.00 [0.00, 0.00] |" in page
    assert "Not finished" not in render_sizes(FOUND, {})
    assert "unfinished" in found.model_dump() and "unfinished" not in FOUND.model_dump()


def test_stages_that_all_sizes_share_are_timed_once() -> None:
    # Of twice 210 s, the 160 s of collect and pair are counted once.
    assert "Total wall time of the stages: 4 min." in render_sizes(FOUND, {})
    alone = FOUND.model_copy(update={"sizes": FOUND.sizes[:1] * 3})
    assert "stages: 5 min" in render_sizes(alone, {})


def test_the_figure_is_on_the_page_where_it_was_drawn() -> None:
    page = render_sizes(FOUND, {"data_efficiency": "some.png"})
    assert "## Data efficiency\n\n![data_efficiency](some.png)\n\nTop: positions and velocities" in page
    assert "Bottom: success in the target by size of the dataset." in page


def test_what_was_chosen_is_a_line_for_each_size() -> None:
    assert "Chosen without the target" not in render_sizes(FOUND, {})
    one = Candidate(row="astra", seed=1, percent=50, success={0: 0.5, 2: 0.7})
    judged = Judged(judge="nas", episodes=5, candidates=[one])
    choice = choice_of(judged, 50, measured={("astra", 1): 0.4}, replicates=100)
    small = SMALL.model_copy(update={"choice": choice})
    sizes = [SizeResults(percent=50, results=small), FOUND.sizes[1]]
    page = render_sizes(FOUND.model_copy(update={"sizes": sizes}), {})
    assert "| 50 % | ASTRA, seed 1 | 0.60 | 0.40 | 0.00 | 0.00 |" in page and "| 100 % | ASTRA" not in page
    untested = small.model_copy(update={"choice": choice_of(judged, 50, measured={}, replicates=100)})
    page = render_sizes(FOUND.model_copy(update={"sizes": [SizeResults(percent=50, results=untested)]}), {})
    assert "| 50 % | ASTRA, seed 1 | 0.60 | - | - | - |" in page


def test_regret_stands_before_the_one_at_random() -> None:
    those = [Candidate(row="astra", seed=seed, percent=50, success={0: 0.6 - 0.1 * seed}) for seed in (0, 1)]
    judged = Judged(judge="nas", episodes=5, candidates=those)
    measured = {("astra", 0): 0.4, ("astra", 1): 0.7}
    small = SMALL.model_copy(update={"choice": choice_of(judged, 50, measured=measured, replicates=100)})
    page = render_sizes(FOUND.model_copy(update={"sizes": [SizeResults(percent=50, results=small)]}), {})
    assert "| size | chosen | predicted [95 %] | in the target | regret | regret at random |" in page
    assert "| 50 % | ASTRA, seed 0 | 0.60 | 0.40 | 0.30 | 0.15 |" in page


def test_a_sweep_without_a_target_says_so_first() -> None:
    sizes = [
        SizeResults(percent=size.percent, results=size.results.model_copy(update={"tested_in": "simulators"}))
        for size in FOUND.sizes
    ]
    page = render_sizes(FOUND.model_copy(update={"sizes": sizes}), {})
    assert page.startswith("# toy\n\n**Nothing was tested on a robot")
    assert "Mean ± standard deviation over seeds, in a simulator." in page


def test_a_choice_is_made_once_for_all_sizes() -> None:
    times = {"select": 60.0, "subset": 20.0, "total": 80.0}
    size = SizeResults(percent=50, results=SMALL.model_copy(update={"wall_seconds": times}))
    page = render_sizes(
        FOUND.model_copy(update={"sizes": [size, size.model_copy(update={"percent": 100})]}), {}
    )
    assert "Total wall time of the stages: 2 min." in page  # 60 + 20 + 20 s


def test_a_sweep_of_a_stand_in_or_of_other_legs_says_so() -> None:
    first = SMALL.model_copy(update={"stand_in": "mujoco", "leg_scale": 1.25})
    sizes = [SizeResults(percent=50, results=first), FOUND.sizes[1]]
    page = render_sizes(FOUND.model_copy(update={"sizes": sizes}), {})
    assert "size and seed. The target's legs are 1.25 times as long. Produced by" in page
    assert "**A simulated stand-in (`mujoco`) replaces the physical robot" in page
    plain = render_sizes(FOUND, {})
    assert "stand-in" not in plain
    assert "legs" not in plain
