from astra_data.reports.origins import merged_origins
from astra_data.reports.schema import Machine, Origin

USUAL = Origin(
    commit="abc",
    machine=Machine(cpu="Fast", cores=8, memory_gib=16.0),
    packages={"torch": "2.0"},
    stages=["train"],
)


def test_an_origin_is_named_once_with_all_stages_that_ran_there() -> None:
    again = USUAL.model_copy(update={"stages": ["align", "train"]})
    assert merged_origins([USUAL, again]) == [USUAL.model_copy(update={"stages": ["train", "align"]})]


def test_other_code_another_machine_and_other_packages_are_other_origins() -> None:
    others = [
        USUAL.model_copy(update=change)
        for change in ({"commit": "def"}, {"machine": None}, {"packages": {"torch": "2.1"}})
    ]
    assert merged_origins([USUAL, *others]) == [USUAL, *others]
