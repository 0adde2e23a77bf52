from collections.abc import Mapping
from pathlib import Path

import pytest
from fake_runs import ROWS, FakeRecipe, write_runs

from astra_data.reports.assembly import assemble
from astra_data.reports.comparing import improvement, summarized
from astra_data.reports.files import FIGURES, published_figures, read_published
from astra_data.reports.page import render
from astra_data.reports.schema import MethodResults, Results
from astra_data.reports.sizes import SizesResults, render_sizes
from astra_data.worlds.score import RETURN, SUCCESS, SURVIVED_STEPS

PUBLISHED = Path(__file__).parents[2] / "recipes/results"
PREDICTIONS = {PUBLISHED / "nao_real.json"}
"""Of `astra-data gap`, whose pages are other ones."""


@pytest.mark.parametrize(
    "path", sorted({*PUBLISHED.glob("*.json")} - PREDICTIONS), ids=lambda path: path.stem
)
def test_a_published_page_is_what_its_numbers_give(path: Path) -> None:
    found = read_published(path)
    figures = {name: f"{path.stem}_{name}.png" for name in published_figures(PUBLISHED, path.stem)}
    page = render_sizes(found, figures) if isinstance(found, SizesResults) else render(found, figures)
    assert page == path.with_suffix(".md").read_text()


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    root = write_runs(tmp_path_factory.mktemp("page"))
    command = "astra-data run recipes/antmaze_u.toml"
    return assemble(FakeRecipe(), root=root, command=command, replicates=100)


@pytest.fixture(scope="module")
def page(results: Results) -> str:
    return render(results, {})


def page_of(results: Results, **changes: object) -> str:
    return render(results.model_copy(update=changes), {})


def rows_of(results: Results, **changes: Mapping[str, object]) -> dict[str, MethodResults]:
    """Return the rows, some of them changed and summarized again."""
    edited = {
        name: summarized(results.methods[name].model_copy(update=of), 100) for name, of in changes.items()
    }
    return results.methods | edited


def test_the_table_has_a_row_for_each_method_and_the_best_in_bold(page: str) -> None:
    assert "| Direct transfer (floor) | 3 | 0.17 ± 0.14 |" in page
    assert "| ASTRA | 3 | 0.50 ± 0.25 |" in page
    assert "| ASTRA+ | 3 | **0.92 ± 0.14** |" in page
    assert "| Careful follower (ceiling) | 3 | 1.00 ± 0.00 | 1.00 [1.00, 1.00] |" in page
    assert "A plus sign marks the same method trained with the recipe's `[plus]` settings." in page
    assert "astra-data run recipes/antmaze_u.toml" in page
    assert "seeds 0, 1, 2, 4 episodes per row and seed. Produced by" in page
    assert "on Fast, 8 cores, 16 GiB of memory, H200. Total wall time of the stages: 3 min.\n" in page


def test_a_task_without_walls_and_places_has_no_columns_of_them(results: Results, page: str) -> None:
    assert "wall contact | steps |" in page and "Wall contact: share of steps." in page
    bare = rows_of(results, **{row: {"wall_contact": [0.0] * 3, "distance": [0.0] * 3} for row in ROWS})
    changed = page_of(results, methods=bare)
    assert "wall contact" not in changed.lower() and "path length to success" not in changed
    assert "| failed | steps | return |" in changed


def test_trainings_are_counted_where_some_were_done_again(results: Results, page: str) -> None:
    assert "| training runs |" not in page
    once = page_of(results, methods=rows_of(results, astra={"tries": [1.0, 1.0, 1.0]}))
    assert "| training runs |" not in once
    again = page_of(results, methods=rows_of(results, astra={"tries": [1.0, 3.0, 2.0]}))
    assert "| success in its simulator | training runs |" in again and "| 2.0 ± 1.0 |" in again


def test_commands_beyond_what_was_recorded_are_told_where_there_are_some(results: Results, page: str) -> None:
    assert "beyond recorded" not in page.lower()
    few = rows_of(results, astra={"beyond_recorded": [0.01, 0.01, 0.0]})
    assert "beyond recorded" not in page_of(results, methods=few).lower()
    many = page_of(results, methods=rows_of(results, astra={"beyond_recorded": [0.9, 1.0, 0.95]}))
    assert "| success in its simulator | beyond recorded commands |" in many
    assert "narrow the bounds of the task's commands" in many
    lines = [line for line in many.splitlines() if line.startswith(("| ASTRA |", "| ASTRA+ |"))][:2]
    assert lines[0].endswith(" | 0.95 ± 0.05 |") and lines[1].endswith(" | - |")


def test_the_papers_figures_stand_beside_ours(results: Results, page: str) -> None:
    assert "| paper |" not in page
    changed = page_of(results, paper_success={"astra": 0.4})
    assert "| method | seeds | success | paper | IQM [95 %] |" in changed
    assert "| ASTRA | 3 | 0.50 ± 0.25 | 0.40 | " in changed
    assert "| ASTRA+ | 3 | **0.92 ± 0.14** | - | " in changed
    assert "compare their order, not their values" in changed


def test_open_loop_errors_have_the_raw_simulator_once_if_all_share_it(results: Results, page: str) -> None:
    assert "| `position_m` | 1 step | 10 steps |" in page
    assert "| No grounding | 1 [0.5, 2] | 2 |" in page
    assert "| ASTRA, grounded | 0.2 [0.1, 0.4] | 0.4 |" in page
    gap = results.methods["astra"].gap
    assert gap is not None
    other = gap.model_copy(update={"raw": gap.grounded})
    rows = rows_of(results, follower={"grounding": "nas", "gap": other})
    changed = page_of(results, methods=rows)
    assert "No grounding" not in changed
    assert "| NAS, no grounding | 0.2 [0.1, 0.4] | 0.4 |" in changed
    assert "| ASTRA, no grounding | 1 [0.5, 2] | 2 |" in changed
    assert "## Gap" not in page_of(results, methods=rows_of(results, **{key: {"gap": None} for key in ROWS}))


def test_cost_gives_the_speed_of_every_stage_and_the_time_of_every_row(page: str) -> None:
    assert "| collect | 15 s | - | 4 k target steps/s |" in page
    assert "| train | - | - | 96 k simulator steps/s; 48 k training steps/s |" in page
    assert "| whole recipe | 3 min | 5 min |  |" in page
    assert "| pair |" not in page  # neither time nor speed recorded
    assert "| method | ground | train | align | evaluate | wall time | CPU time |" in page
    for row in ("ASTRA", "ASTRA+"):
        assert f"| {row} | 7 s | - | - | 10 s | 17 s | 34 s |" in page


def test_validity_is_of_both_simulators_and_names_who_was_not_tested(results: Results, page: str) -> None:
    assert "| simulator | policies | Pearson [95 %] | Spearman [95 %] |" in page
    assert "| raw | 12 | 0.96 [" in page
    assert "| grounded | 9 | -1.00 [-1.00, -1.00] | -1.00 [-1.00, -1.00] |" in page
    assert "The grounding is each row's own." in page
    assert "Without" not in page
    untested = rows_of(results, follower={"simulator_returns": {}})
    assert (
        " Without Careful follower: policies that observe the full state cannot be tested there"
        in page_of(results, methods=untested)
    )
    by_nas = {"nas": results.methods["astra"], **results.methods}
    assert "The grounding is NAS's, of the same seed." in page_of(results, methods=by_nas)
    raw = results.predictive_validity["raw"].model_copy(update={"pearson": None})
    assert "| raw | 12 | - | 1.00 [" in page_of(results, predictive_validity={"raw": raw})
    assert "Predictive validity" not in page_of(results, predictive_validity={})


def test_rows_that_were_trained_in_the_target_are_set_apart(results: Results, page: str) -> None:
    assert "learned in the target itself" not in page
    rows = rows_of(results, astra_plus={"role": "trained there"})
    changed = page_of(results, methods=rows)
    assert "| ASTRA | 3 | **0.50 ± 0.25** |" in changed
    assert "| ASTRA+ (trained there) | 3 | 0.92 ± 0.14 |" in changed
    assert "learned in the target itself" in changed


def test_the_head_names_what_is_special(results: Results) -> None:
    changed = page_of(results, leg_scale=1.25, stand_in="mujoco", unfinished=["RMA", "NAS"])
    assert "4 episodes per row and seed. The target's legs are 1.25 times as long. Produced by" in changed
    assert (
        "stages: 3 min. Not finished yet: RMA, NAS.\n\n**A simulated stand-in (`mujoco`) replaces" in changed
    )
    partly = page_of(results, methods=rows_of(results, astra={"seeds": [0, 1], "success": [0.5, 1.0]}))
    assert "seeds 0, 1, 2 (the table has the number of seeds of each row), 4 episodes per row" in partly
    assert "| ASTRA | 2 | 0.75 ± 0.35 |" in partly
    unknown = page_of(results, origins=[])
    assert "on a machine that was not recorded. Total wall time" in unknown


def test_of_lasting_tasks_the_page_shows_survived_steps_and_return(results: Results) -> None:
    scores = SURVIVED_STEPS, RETURN
    means = {"steps": [40.0, 50.0, 60.0], "return": [200.0, 201.0, 202.0]}
    rows = rows_of(
        results,
        astra={"steps": [60.0, 90.0, 600.0], "encoders": {"source": means, "target": means}},
        astra_plus={"encoders": {}},
    )
    beats = improvement(rows, SURVIVED_STEPS, 100)
    page = page_of(results, methods=rows, scores=scores, probability_of_improvement=beats)
    columns = "survived steps | IQM [95 %] | return | IQM [95 %]"
    assert f"| method | seeds | {columns} | failed | survived steps in its simulator |" in page
    assert "| ASTRA | 3 | **250 ± 303** | " in page
    assert "| **1.0 ± 1.0** | 1.0 [0.0, 2.0] | 0.50 ± 0.25 | 115 ± 0 |" in page
    assert "has a higher number of survived steps than" in page
    # Direct transfer lasts 115 steps with every seed.
    assert "| ASTRA | Direct transfer | 0.33 [" in page
    assert "| method | encoder | survived steps | return |" in page
    assert "| ASTRA | source | 50 ± 10 | 201.0 ± 1.0 |" in page
    assert "Survived steps: steps until an episode fails or its time is up." in page
    assert "success" not in page


def test_another_headline_has_the_columns_of_success_beside_it(results: Results) -> None:
    rows = rows_of(results, **{row: {"encoders": {}} for row in results.methods})
    page = page_of(results, methods=rows, scores=(RETURN, SUCCESS))
    assert "| method | seeds | return | IQM [95 %] | success | IQM [95 %] | failed | " in page


def test_every_figure_has_a_place_on_a_page_and_only_those_drawn_are_shown(results: Results) -> None:
    assert "![" not in render(results, {})
    rows = rows_of(results, **{key: {"encoders": {}} for key in ROWS})
    scores = (SUCCESS, SURVIVED_STEPS, RETURN)
    images = {name: f"x_{name}.png" for name in FIGURES}
    page = render(results.model_copy(update={"scores": scores, "methods": rows}), images)
    shown = [name for name in FIGURES if f"]({images[name]})\n\n" in page]
    assert shown == [name for name in FIGURES if name != "data_efficiency"]
    places = [page.index(images[name]) for name in shown]
    assert places == sorted(places)
    alone = render(results, {"gap": "gap.png"})
    assert "## Open-loop error by horizon\n\n![Open-loop error by horizon](gap.png)\n\nThe simulator" in alone


def test_errors_are_of_the_horizons_that_all_groundings_have(results: Results) -> None:
    gap = results.methods["astra"].gap
    assert gap is not None
    short = {
        name: band.model_copy(update={"mean": [3.0], "low": [2.0], "high": [4.0]})
        for name, band in gap.raw.items()
    }
    other = gap.model_copy(update={"horizons": [1], "raw": short, "grounded": short})
    for order in (("nas", "astra"), ("astra", "nas")):
        gaps = {"nas": other, "astra": gap}
        rows = rows_of(
            results,
            follower={"grounding": order[0], "gap": gaps[order[0]]},
            astra={"grounding": order[1], "gap": gaps[order[1]]},
        )
        page = page_of(results, methods=rows)
        assert "| `position_m` | 1 step |\n" in page
        assert "| NAS, grounded | 3 [2, 4] |\n" in page
        assert "| ASTRA, grounded | 0.2 [0.1, 0.4] |\n" in page


def test_who_stands_still_is_the_first_line_where_it_was_measured(results: Results, page: str) -> None:
    gap = results.methods["astra"].gap
    assert gap is not None
    assert "Standing still" not in page
    other = gap.model_copy(update={"still": gap.raw})
    shown = page_of(results, methods=rows_of(results, astra={"gap": other}, astra_plus={"gap": other}))
    assert "| Standing still | 1 [0.5, 2] | 2 |\n| No grounding | 1 [0.5, 2] | 2 |\n" in shown


def test_paths_are_said_to_be_of_where_the_policies_were_tested(results: Results) -> None:
    drawn = {"trajectories": "paths.png"}
    assert "Blue: the same policy in the target." in render(results, drawn)
    untested = render(results.model_copy(update={"tested_in": "simulators"}), drawn)
    assert "Blue: the same policy in a simulator." in untested
    assert "The number is the success rate in a simulator over all" in untested
