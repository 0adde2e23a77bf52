import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.grounding.history import HistoryGrounding
from astra_data.worlds.user_code import parts_of, restored, user_object


class Linear:
    """What a user wrote, whose parts on disk are wrong in some way."""

    def __init__(self, returned: object) -> None:
        self.returned = returned

    def to_file(self) -> Any:  # noqa: ANN401 - as a user would write it
        return self.returned() if callable(self.returned) else self.returned


@pytest.mark.parametrize("kind", [tuple, list])
def test_tensors_and_json_values_are_as_they_were(kind: Callable[[Any], Any]) -> None:
    tensors, metadata = {"matrix": torch.ones(2)}, {"sizes": [1, 2], "name": None}
    assert parts_of(Linear(kind([tensors, metadata]))) == (tensors, metadata)


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        (
            ({"w": np.ones(2), "b": torch.ones(1), "n": 3}, {}),
            r"'w' is a ndarray, expected a torch tensor, as torch.as_tensor\(value\) is; 'n' is a int, .*",
        ),
        (
            ({"w": torch.ones(1)}, {"sizes": [1], "mean": torch.ones(2), "at": [np.float32(1)]}),
            "'mean' is a Tensor, expected a JSON value, or it among the tensors; 'at' is a list, .*",
        ),
        ({"w": torch.ones(1)}, "expected a pair, a dict of tensors and one of JSON values, got a dict"),
        (None, "expected a pair, .*, got a NoneType"),
        ((), "expected a pair, .*, got a tuple of nothing"),
        ((torch.ones(1), {}), "expected a pair, .*, got a tuple of Tensor, dict"),
        (({}, {}, {}), "expected a pair, .*, got a tuple of dict, dict, dict"),
    ],
)
def test_anything_else_is_told(returned: object, told: str) -> None:
    with pytest.raises(BadInputError, match=f"^Linear.to_file: {told}$"):
        parts_of(Linear(returned))


def test_a_failure_is_told() -> None:
    with pytest.raises(BadInputError, match=r"^Linear.to_file fails with KeyError: 'NO_SUCH'"):
        parts_of(Linear(lambda: os.environ["NO_SUCH"]))


OWN = """
import torch

class Own:
    @classmethod
    def from_file(cls, tensors, metadata, *device):
        {body}
"""
TENSORS, METADATA = {"matrix": torch.ones(2), "factor": torch.ones(1)}, {"sizes": [2], "kind": "mine"}


def made_of(body: str, folder: Path) -> Any:  # noqa: ANN401 - a class of a user's
    (folder / "mine.py").write_text(OWN.format(body=body))
    return user_object(f"{folder / 'mine.py'}:Own")


def test_what_it_builds_is_returned(tmp_path: Path) -> None:
    own = made_of("return tensors, metadata, device", tmp_path)
    assert restored(own, TENSORS, METADATA) == (TENSORS, METADATA, ())
    assert restored(own, TENSORS, METADATA, "cpu") == (TENSORS, METADATA, ("cpu",))


@pytest.mark.parametrize("asked", ['tensors["matrx"]', 'metadata["matrx"]'])
def test_what_it_asks_for_and_the_file_has_not_is_told_with_what_it_has(asked: str, tmp_path: Path) -> None:
    with pytest.raises(
        BadInputError,
        match=r"^Own.from_file asks for 'matrx', which its to_file did not write: the file has the tensors "
        r"matrix, factor, and sizes, kind beside them: correct it or to_file, and run that stage again$",
    ):
        restored(made_of(f"return {asked}", tmp_path), TENSORS, METADATA)
    with pytest.raises(BadInputError, match="the tensors matrix, factor, and nothing beside them"):
        restored(made_of(f"return {asked}", tmp_path), TENSORS, {})


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ('return {}["matrix"]', "KeyError: 'matrix'"),
        ("return {}[0]", "KeyError: 0"),
        ("raise KeyError", "KeyError:"),
        ("return tensors.matrix", "AttributeError: 'dict' object has no attribute 'matrix'"),
        (
            "return torch.nn.Linear(1, 1).load_state_dict(tensors)",
            r"RuntimeError: Error\(s\) in loading state_dict for Linear: Missing key\(s\) .*",
        ),
    ],
)
def test_other_failures_are_told_in_a_line_with_their_place(body: str, told: str, tmp_path: Path) -> None:
    with pytest.raises(
        BadInputError,
        match=rf"^Own.from_file fails with {told} \(mine.py, line 7\): correct it or to_file, and run that "
        "stage again$",
    ):
        restored(made_of(body, tmp_path), TENSORS, METADATA)


def test_failures_of_the_package_are_the_caller_s_to_explain() -> None:
    empty: tuple[dict[str, Tensor], Mapping[str, Any]] = ({}, {})
    with pytest.raises(KeyError, match="shape"):
        restored(HistoryGrounding, *empty, "cpu")
