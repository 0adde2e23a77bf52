from astra_data.core.naming import (
    artifact_key,
    base_method,
    is_plus,
    reference_of,
    row_of_key,
    seed_folder,
    stage_of_key,
)


def test_a_row_is_a_method_or_its_plus() -> None:
    assert [is_plus(row) for row in ("astra", "astra_plus", "plus_astra")] == [False, True, False]
    assert [base_method(row) for row in ("astra", "astra_plus")] == ["astra", "astra"]


def test_rows_are_tested_in_nas_if_it_is_among_them() -> None:
    assert reference_of(["astra", "nas"]) == reference_of(["astra", "nas_plus"]) == "nas"
    assert reference_of(["astra", "compass"]) is None


def test_folders_of_seeds_lie_in_those_of_sizes() -> None:
    assert seed_folder(3) == "seed_3"
    assert seed_folder(3, 5) == "percent_005/seed_3"


def test_a_key_is_the_place_in_a_run() -> None:
    assert artifact_key("train", "astra", 3, 5) == "train/astra/percent_005/seed_3"
    assert artifact_key("pair", "", 0) == "pair/seed_0"


def test_a_key_begins_with_its_stage() -> None:
    assert [stage_of_key(key) for key in ("train/astra/seed_0", "select", "pair/seed_1")] == [
        *("train", "select", "pair")
    ]


def test_a_rows_key_goes_on_with_the_row_and_no_other_part_is_one() -> None:
    keys = ["train/astra/seed_0", "train/train/percent_050/seed_0", "ground/nas/seed_1", "report"]
    assert [row_of_key(key) for key in keys] == ["astra", "train", "nas", ""]
