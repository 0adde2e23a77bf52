import pytest
from fake_runs import ROWS, SEEDS, FakeRecipe, write_runs

from astra_data.reports.assembly import assemble
from astra_data.reports.comparing import summarized
from astra_data.reports.losses import loss_head, losses, remaining_errors, seed_lines
from astra_data.reports.schema import Results
from astra_data.worlds.score import RETURN, SURVIVED_STEPS


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    root = write_runs(tmp_path_factory.mktemp("losses"))
    return assemble(FakeRecipe("toy"), root=root, command="", replicates=100)


def changed(results: Results, row: str, **of: object) -> Results:
    edited = summarized(results.methods[row].model_copy(update=of), 100)
    return results.model_copy(update={"methods": results.methods | {row: edited}})


def test_outcomes_add_up_and_those_out_of_time_are_the_rest(results: Results) -> None:
    found = changed(results, "astra", success=[0.5, 0.25, 0.75], failed=[0.25, 0.25, 0.0])
    row = losses(found)[1]
    assert (row.name, row.title, row.role) == ("astra", "ASTRA", None)
    assert row.outcomes == pytest.approx({"success": 0.5, "failed": 1 / 6, "out of time": 1 / 3})
    assert row.simulated == pytest.approx(0.75)
    assert row.cells[3:] == ["0.25", "0.17 ± 0.14", "0.33 ± 0.14", "3"]
    assert len(row.cells) == len(loss_head(found))


def test_no_episode_is_out_of_time_where_all_succeed_or_fail(results: Results) -> None:
    found = changed(results, "astra", success=[0.9] * 3, failed=[0.1] * 3)  # 1 - 0.9 - 0.1 is below 0
    row = losses(found)[1]
    assert row.cells[4:6] == ["0.10 ± 0.00", "0.00 ± 0.00"] and row.outcomes["out of time"] == 0.0


def test_a_row_without_a_simulator_loses_nothing_there(results: Results) -> None:
    follower = losses(results)[-1]
    assert (follower.role, follower.simulated) == ("ceiling", None)
    assert follower.cells[0] == follower.cells[3] == "-"


def test_a_gain_is_negative_and_a_rounded_zero_has_no_sign(results: Results) -> None:
    gained = changed(results, "astra", success=[1.0, 1.0, 1.0])
    assert losses(gained)[1].cells[3] == "-0.25"
    level = changed(results, "astra", success=[0.751, 0.751, 0.751])
    assert losses(level)[1].cells[3] == "0.00"


def test_of_lasting_tasks_steps_are_lost_and_shares_last(results: Results) -> None:
    lasting = results.model_copy(update={"scores": (SURVIVED_STEPS, RETURN)})
    row = losses(lasting)[1]
    assert loss_head(lasting)[-4:] == ["lost", "failed", "lasted", "seeds"] and len(
        loss_head(lasting)
    ) == len(row.cells)
    assert row.outcomes == pytest.approx({"lasted": 0.5, "failed": 0.5}) and row.simulated is None
    assert row.cells[-4:] == ["0", "0.50 ± 0.25", "0.50 ± 0.25", "3"]


def test_every_seed_has_a_line_with_what_some_row_has(results: Results) -> None:
    head, lines = seed_lines(results)
    assert head[:4] == ["row", "seed", "success", "failed"] and "tries" not in head
    assert len(lines) == len(ROWS) * len(SEEDS) and {len(line) for line in lines} == {len(head)}
    assert lines[4][:3] == ["ASTRA", "1", "0.25"]
    assert lines[-1][head.index("simulated success")] == "-"


def test_what_is_left_of_an_error_is_told_at_ten_steps_or_before(results: Results) -> None:
    # A mean over seeds of 0.2 by 0.1, 0.2 and 0.3 after one step, of which ten have twice as much.
    assert remaining_errors(results) == (10, ["astra"], [["position_m", "0.4 of 2 (20 %)"]])
    copy = results.model_copy(deep=True)
    [gap] = copy.gaps().values()
    gap.horizons[:] = [1, 11]
    assert remaining_errors(copy) == (1, ["astra"], [["position_m", "0.2 of 1 (20 %)"]])
    gap.horizons[:] = [11, 12]
    assert remaining_errors(copy) == (11, ["astra"], [["position_m", "0.2 of 1 (20 %)"]])
