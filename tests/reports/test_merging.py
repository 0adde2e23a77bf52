import shutil
from pathlib import Path

import numpy as np
import pytest
from fake_runs import ROWS, SEEDS, FakeRecipe, band, edit_json, write_elsewhere, write_runs

from astra_data.core.errors import BadInputError, MissingStageError
from astra_data.reports.assembly import assemble
from astra_data.reports.schema import Cost, Results

ALL = (*ROWS, "iql")


def assembled(
    root: Path,
    methods: tuple[str, ...] = ALL,
    seeds: tuple[int, ...] = SEEDS,
    published: Results | None = None,
) -> Results:
    found = assemble(
        FakeRecipe(methods=methods, seeds=seeds), root=root, command="", replicates=10, published=published
    )
    # Published results come from a file.
    return Results.model_validate_json(found.model_dump_json(by_alias=True))


def content(results: Results, *apart: str) -> str:
    """Return the content of results but for some fields, with equal NaNs."""
    values = results.model_dump(exclude=set(apart))
    for row in values["methods"].values():
        row["gap"] = None
    return repr(values)


def remove(root: Path, method: str, seed: int) -> None:
    shutil.rmtree(root / f"evaluate/{method}/seed_{seed}")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = write_runs(tmp_path)
    write_elsewhere(root, "iql")
    for seed in SEEDS:
        edit_json(root / f"evaluate/astra/seed_{seed}/evaluation.json", wall_seconds=10.0 + 3 * seed)
    return root


def test_the_code_of_published_rows_stays_named(root: Path) -> None:
    (root / "code.json").write_text('{"task": "0a", "iql": "1b"}')
    published = assembled(root, methods=("iql",))
    for seed in (0, 1, 2):
        remove(root, "iql", seed)
    assert assembled(root, methods=("astra", "iql"), published=published).own_code == {
        "task": "0a",
        "iql": "1b",
    }


def test_seeds_found_apart_amount_to_what_they_do_together(root: Path) -> None:
    edit_json(root / "ground/astra/seed_1/gap.json", grounded={"position_m": band(0.7)})
    whole = assembled(root)
    published = assembled(root, seeds=(1,))
    for method in ALL:
        remove(root, method, 1)
    merged = assembled(root, published=published)
    # Some of the groundings and datasets are in both.
    counted = ("wall_seconds", "cpu_seconds", "throughput")
    assert content(merged, *counted) == content(whole, *counted)
    assert merged.wall_seconds["evaluate"] == whole.wall_seconds["evaluate"]
    assert merged.cpu_seconds["evaluate"] == whole.cpu_seconds["evaluate"]
    assert merged.methods["astra"].cost["evaluate"] == Cost(wall_seconds=13.0, cpu_seconds=20.0)
    assert sorted(merged.throughput["evaluate"]["target_steps_per_second"]["astra"]) == [1000, 1001, 1002]
    gap, at_once = merged.gaps()["astra"], whole.gaps()["astra"]
    assert (gap.seeds, gap.horizons) == (at_once.seeds, at_once.horizons) == ([0, 1, 2], [1, 10])
    assert gap.raw.keys() == gap.grounded.keys() == at_once.grounded.keys()
    for found, known in ((gap.grounded, at_once.grounded), (gap.raw, at_once.raw)):
        for quantity, of_both in found.items():
            for ends in ("mean", "low", "high"):
                assert getattr(of_both, ends) == pytest.approx(getattr(known[quantity], ends))


def test_rows_found_apart_amount_to_what_they_do_together(root: Path) -> None:
    whole = assembled(root)
    published = assembled(root, ("astra_plus", "follower"))
    for seed in SEEDS:
        remove(root, "astra_plus", seed)
        remove(root, "follower", seed)
    assert assembled(root).unfinished == ["ASTRA+", "Careful follower"]
    merged = assembled(root, published=published)
    counted = ("wall_seconds", "cpu_seconds", "throughput")
    assert content(merged, *counted) == content(whole, *counted)
    assert repr(merged.methods["astra_plus"].gap) == repr(whole.methods["astra"].gap)


def test_what_is_found_anew_replaces_what_is_published(root: Path) -> None:
    published = assembled(root)
    path = root / "evaluate/astra/seed_2/evaluation.json"
    edit_json(path, raw=None)
    for method in (*ROWS, "iql"):
        for seed in SEEDS if method != "astra" else (0, 1):
            remove(root, method, seed)
    edit_json(root / "ground/astra/seed_2/gap.json", horizons=[1], grounded={}, raw={})
    astra = assembled(root, published=published).methods["astra"]
    assert astra.seeds == [0, 1, 2]
    assert astra.success == [0.5, 0.25, 0.75]
    assert list(astra.simulator_returns) == ["grounded"]
    # Of three seeds, not of one.
    assert astra.gap is not None and astra.gap.horizons == [1, 10]


def test_gaps_of_other_quantities_are_not_averaged(root: Path) -> None:
    published = assembled(root, seeds=(1,))
    for method in ALL:
        remove(root, method, 1)
    for seed in (0, 2):
        edit_json(
            root / f"ground/astra/seed_{seed}/gap.json", grounded={"x_m": band(0.1)}, raw={"x_m": band(1)}
        )
    gap = assembled(root, published=published).gaps()["astra"]
    assert (gap.seeds, list(gap.grounded)) == ([0, 2], ["x_m"])


def test_of_gaps_over_as_many_seeds_the_newer_one_counts(root: Path) -> None:
    published = assembled(root)
    for seed in SEEDS:
        remove(root, "follower", seed)
        edit_json(root / f"ground/astra/seed_{seed}/gap.json", horizons=[1], grounded={}, raw={})
    gap = assembled(root, published=published).methods["astra"].gap
    assert gap is not None and (gap.horizons, gap.seeds) == ([1], list(SEEDS))


def test_results_added_to_themselves_stay_as_they_are(root: Path) -> None:
    found = assembled(root)
    assert content(assembled(root, published=found)) == content(found)


def test_published_results_alone_are_enough(root: Path) -> None:
    published = assembled(root)
    shutil.rmtree(root)
    assert content(assembled(root, published=published)) == content(published)
    based_on_it = published.model_copy(update={"recipe": "base"})
    fewer = assembled(root, ("astra", "nas"), (0, 2), based_on_it)
    assert fewer.recipe == "antmaze_u"
    assert fewer.methods["astra"].success == [0.5, 0.75]
    assert (list(fewer.methods), fewer.seeds, fewer.unfinished) == (["astra"], [0, 2], ["NAS"])
    with pytest.raises(MissingStageError):
        assembled(root)


def test_a_row_without_a_measure_stays_without(root: Path) -> None:
    published = assembled(root, ("direct_transfer",), (0,))
    path = root / "evaluate/direct_transfer/seed_1/evaluation.json"
    edit_json(path, simulated=None)
    remove(root, "direct_transfer", 0)
    remove(root, "direct_transfer", 2)
    row = assembled(root, ("direct_transfer",), published=published).methods["direct_transfer"]
    assert (row.seeds, row.simulated_success) == ([0, 1], None)
    assert row.distance == pytest.approx([8.0, np.nan], nan_ok=True)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episodes": 5}, "episodes per row and seed: 5 and 4"),
        ({"leg_scale": 1.25}, r"scale of the legs: 1.25 and 1.0"),
        ({"task": "antmaze-long"}, "task: antmaze-long and antmaze-u"),
        ({"tested_in": "simulators"}, "place of the tests: simulators and target"),
    ],
)
def test_results_that_are_not_alike_are_not_added(
    root: Path, changes: dict[str, object], message: str
) -> None:
    published = assembled(root).model_copy(update=changes)
    with pytest.raises(BadInputError, match=message):
        assembled(root, published=published)


@pytest.mark.parametrize("other", ["other", "another"])
def test_results_of_other_data_are_not_added(root: Path, other: str) -> None:
    published = assembled(root)
    remove(root, "astra", 0)
    edit_json(root / "pair/seed_1/meta/astra/dataset.json", content_hash=other)
    with pytest.raises(BadInputError, match=f"pair seed 1 with content hash1 and {other}"):
        assembled(root, published=published)


def test_without_a_target_no_simulator_is_said_to_predict_it(root: Path) -> None:
    published = assembled(root)
    assert published.predictive_validity.keys() == {"raw", "grounded"}
    shutil.rmtree(root)
    elsewhere = published.model_copy(update={"tested_in": "simulators"})
    assert assembled(root, published=elsewhere).predictive_validity == {}
