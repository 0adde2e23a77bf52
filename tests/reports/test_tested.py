from types import SimpleNamespace
from typing import Any, cast

import pytest

from astra_data.reports.schema import Results
from astra_data.reports.tested import warning, where


def results(tested_in: str, *rows: str) -> Results:
    found: Any = SimpleNamespace(tested_in=tested_in, methods=dict.fromkeys(rows))
    return cast(Results, found)


@pytest.mark.parametrize(
    ("rows", "words", "told"),
    [
        (("direct_transfer", "nas"), "in the simulator grounded by NAS", "in which only NAS trained. "),
        (("nas", "nas_plus", "astra"), "in the simulator grounded by NAS", "only NAS and NAS+ trained. "),
        (
            ("direct_transfer", "astra"),
            "in a simulator",
            "Each row was tested in the simulator it was trained in",
        ),
    ],
)
def test_results_without_a_target_say_so_first(rows: tuple[str, ...], words: str, told: str) -> None:
    found = results("simulators", *rows)
    assert where(found) == words
    assert warning(found).startswith("**Nothing was tested on a robot") and told in warning(found)


def test_results_of_a_target_are_not_warned_of() -> None:
    found = results("target", "nas")
    assert (where(found), warning(found)) == ("in the target", "")
