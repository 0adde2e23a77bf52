import shutil
from pathlib import Path

import pytest
from fake_runs import MADE, ROWS, SEEDS, FakeRecipe, write_evaluation, write_json, write_runs

from astra_data.core.errors import BadInputError, MissingStageError
from astra_data.reports.artifacts import Gap
from astra_data.reports.runs import Runs


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_runs(tmp_path)


def runs(
    root: Path,
    methods: tuple[str, ...] = ROWS,
    seeds: tuple[int, ...] = SEEDS,
    percent: int | None = None,
) -> Runs:
    return Runs(FakeRecipe(methods=methods, seeds=seeds), root, percent)


def test_a_row_has_the_seeds_that_it_has_finished_of_those_asked_for(root: Path) -> None:
    shutil.rmtree(root / "evaluate/astra/seed_1")
    shutil.rmtree(root / "evaluate/follower")
    assert runs(root, seeds=(0, 1)).finished == {
        "direct_transfer": (0, 1),
        "astra": (0,),
        "astra_plus": (0, 1),
    }
    found = runs(root, ("astra",)).evaluations()
    assert [file.seed for file in found["astra"].values()] == list(found["astra"]) == [0, 2]


def test_rows_share_the_artifacts_of_their_base_or_of_the_row_that_is_named(root: Path) -> None:
    named = "astra_task_reward"
    read = runs(root, ("astra_plus", named))
    assert read.owner("ground", "astra_plus") == read.owner("align", named) == "astra"
    assert read.owner("train", named) == named
    (root / "ground" / named).mkdir()
    assert (read.owner("ground", named), read.owner("align", named)) == (named, "astra")
    # Both rows have all seeds of the one grounding, which is read once.
    assert list(runs(root).optional("ground", "gap.json", Gap)) == ["astra"]


def test_each_size_has_folders_of_its_own(root: Path) -> None:
    assert runs(root, percent=25).path("train", "astra", 3, "curve.json") == (
        root / "train/astra/percent_025/seed_3/curve.json"
    )
    assert not runs(root, percent=25).any_finished
    write_evaluation(root, "astra", 1, 25)
    assert runs(root, percent=25).finished == {"astra": (1,)}
    write_json(
        root / "subset/percent_025/seed_1/meta/astra/dataset.json",
        MADE | {"name": "a", "version": "v", "content_hash": "c"},
    )
    assert list(runs(root, percent=25).datasets("subset")) == [1]
    assert list(runs(root, percent=25).datasets("collect")) == [0, 1, 2]


def test_what_is_missing_is_named(root: Path) -> None:
    (root / "ground/astra/seed_2/gap.json").unlink()
    with pytest.raises(MissingStageError) as error:
        runs(root).optional("ground", "gap.json", Gap)
    message = str(error.value)
    assert (
        f"expected gap.json in {root}/ground/<method>/seed_<seed>/, found none for astra seed 2;" in message
    )
    assert message.endswith("run the recipe antmaze_u again: it continues with what is missing")
    shutil.rmtree(root / "evaluate")
    with pytest.raises(MissingStageError, match=r"direct_transfer seed 0, 1, 2; astra seed 0, 1, 2; .*; run"):
        _ = runs(root).finished


def test_what_is_missing_of_a_size_is_named_with_its_folder(root: Path) -> None:
    with pytest.raises(
        MissingStageError, match=r"evaluate/<method>/percent_050/seed_<seed>/, found none for a"
    ):
        _ = runs(root, ("astra",), percent=50).finished


def test_rows_and_seeds_are_needed(root: Path) -> None:
    for nothing in ({"methods": ()}, {"seeds": ()}):
        with pytest.raises(BadInputError, match="antmaze_u: expected methods and seeds"):
            runs(root, **nothing)  # type: ignore[arg-type]
