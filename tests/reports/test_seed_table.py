import numpy as np
import pytest
from fake_runs import bare_results

from astra_data.reports.schema import BandMeans, Cost, DatasetUse, GapMeans, Learning, MethodResults, Results
from astra_data.reports.seed_table import Line, lines_of, row_of

CURVES = [Learning(steps=[float(seed)], score=[0.5]) for seed in range(3)]
BAND = BandMeans(mean=[1.0], low=[0.5], high=[2.0])
GAP = GapMeans(seeds=[5, 7, 9], horizons=[1], grounded={"x_m": BAND}, raw={"x_m": BAND})


def results() -> Results:
    bare = bare_results("toy", {"astra": [5, 7, 9]}, {})
    row = bare.methods["astra"].model_copy(
        update={
            "title": "ASTRA",
            "success": [0.1, 0.2, 0.3],
            "simulated_success": [0.4, 0.5, 0.6],
            "simulator_returns": {"raw": [1.0, 2.0, 3.0], "grounded": [4.0, 5.0, 6.0]},
            "encoders": {"source": {"success": [0.0, 0.1, 0.2]}},
            "learning": CURVES,
            "cost": {"train": Cost(wall_seconds=10, cpu_seconds=20)},
            "grounding": "astra",
            "gap": GAP,
        }
    )
    use = DatasetUse(versions=["v1", "v1", None], hashes=["a", "b", None], methods=["astra"])
    return bare.model_copy(update={"methods": {"astra": row}, "evaluated_with": [use]})


def test_a_line_holds_the_values_of_one_seed() -> None:
    line = lines_of(results())[1]
    assert (line.method, line.seed, line.grounding, line.dataset) == ("astra", 7, "astra", ("v1", "b"))
    assert (line.values["success"], line.values["simulated_steps"]) == (0.2, None)
    assert line.values["simulator_returns"] == {"raw": 2.0, "grounded": 5.0}
    assert line.values["encoders"] == {"source": {"success": 0.1}}
    assert line.values["learning"] == CURVES[1]


def test_a_row_is_its_lines_again() -> None:
    found = results()
    assert row_of(lines_of(found), {"astra": GAP}) == found.methods["astra"]


def regrouped(*lines: Line) -> MethodResults:
    return row_of(lines, {"astra": GAP})


def changed(line: Line, **values: object) -> Line:
    return Line(line.method, line.seed, {**line.values, **values}, None, {}, (None, None))


def test_a_row_has_what_all_its_seeds_have() -> None:
    first, second, third = lines_of(results())
    row = regrouped(
        third, changed(first, simulated_success=None, simulator_returns={"grounded": 7.0}, learning=None)
    )
    assert row.seeds == [9, 5]
    assert row.success == [0.3, 0.1]
    assert (row.simulated_success, row.learning) == (None, [])
    assert row.simulator_returns == {"grounded": [6.0, 7.0]}
    assert row.grounding == "astra" and row.gap == GAP
    assert regrouped(changed(second)).gap is None


def test_nan_is_a_value() -> None:
    (first, *_) = lines_of(results())
    row = regrouped(changed(first, distance=float("nan")), changed(first, distance=2.0))
    assert np.isnan(row.distance[0]) and row.distance[1] == 2.0


def test_the_cost_of_a_stage_is_the_mean_over_the_seeds_that_have_it() -> None:
    costs = (
        {"train": Cost(wall_seconds=10, cpu_seconds=None), "align": Cost(wall_seconds=1, cpu_seconds=1)},
        {"train": Cost(wall_seconds=16, cpu_seconds=4)},
    )
    first = lines_of(results())[0]
    lines = [Line("astra", seed, first.values, None, cost, (None, None)) for seed, cost in enumerate(costs)]
    align, train = Cost(wall_seconds=1, cpu_seconds=1), Cost(wall_seconds=13, cpu_seconds=None)
    assert row_of(lines, {}).cost == {"train": train, "align": align}
    assert row_of(lines[1:] * 2, {}).cost["train"].cpu_seconds == pytest.approx(4.0)
