from pathlib import Path

import pytest

from astra_data.core.errors import BadInputError
from astra_data.reports.origins import code_of_rows, merged_origins
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


def test_the_code_of_ones_own_is_that_of_the_task_and_the_rows(tmp_path: Path) -> None:
    assert code_of_rows(tmp_path, ["nas"]) == {}
    recorded = '{"task": "0a", "nas": "1b", "nas.settings": "{}", "compass": "2c"}'
    (tmp_path / "code.json").write_text(recorded)
    assert code_of_rows(tmp_path, ["nas_plus", "nas", "direct_transfer"]) == {"task": "0a", "nas": "1b"}
    assert code_of_rows(tmp_path, []) == {"task": "0a"}
    (tmp_path / "code.json").write_text("[]")
    with pytest.raises(BadInputError, match=r"code\.json is not what a run writes: .*; restore it"):
        code_of_rows(tmp_path, ["nas"])
