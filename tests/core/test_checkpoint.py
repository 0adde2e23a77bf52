import time
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from astra_data.core.artifact import write_manifest
from astra_data.core.checkpoint import CHECKPOINT_SECONDS, Logbook, load_tensors, save_tensors, understood
from astra_data.core.errors import BadInputError


def assert_same(actual: object, expected: object) -> None:
    assert type(actual) is type(expected)
    if isinstance(expected, Tensor):
        assert torch.equal(torch.as_tensor(actual), expected)
    elif isinstance(expected, Mapping):
        assert isinstance(actual, Mapping) and list(actual) == list(expected)
        for key in expected:
            assert_same(actual[key], expected[key])
    elif isinstance(expected, list | tuple):
        assert isinstance(actual, list | tuple) and len(actual) == len(expected)
        for one, other in zip(actual, expected, strict=True):
            assert_same(one, other)
    else:
        assert actual == expected


def test_nothing_is_not_saved(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="at least one tensor"):
        save_tensors(tmp_path / "a.safetensors", {}, {})


def test_files_that_are_missing_damaged_or_foreign_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    with pytest.raises(BadInputError, match="does not exist"):
        load_tensors(path)
    save_tensors(path, {"a": torch.ones(100)}, {})
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(BadInputError, match="not a complete safetensors file"):
        load_tensors(path)
    save_file({"a": torch.ones(1)}, path, {"format": "pt"})
    with pytest.raises(BadInputError, match="not written by astra-data"):
        load_tensors(path)


def test_a_file_that_its_manifest_does_not_know_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "policy.safetensors"
    save_tensors(path, {"weight": torch.ones(3)}, {})
    write_manifest(tmp_path, {})
    assert torch.equal(load_tensors(path)[0]["weight"], torch.ones(3))
    whole = bytearray(path.read_bytes())
    whole[-1] ^= 1  # still a safetensors file
    path.write_bytes(whole)
    with pytest.raises(BadInputError, match=r"policy\.safetensors was altered since it was made: restore"):
        load_tensors(path)
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(BadInputError, match=rf"^manifest\.json cannot be read in {tmp_path}"):
        load_tensors(path)


@pytest.mark.parametrize(
    ("name", "value", "is_refused"),
    [
        ("layer.weight", float("nan"), True),
        ("layer.weight", float("inf"), True),
        ("state_std", float("nan"), True),
        ("state_std", float("inf"), False),
        ("layer.weight", 1e30, False),
    ],
)
def test_weights_that_are_not_finite_are_refused(tmp_path: Path, name: str, value: float, is_refused: bool) -> None:
    path = tmp_path / "a.safetensors"
    save_tensors(path, {name: torch.tensor([1.0, value]), "whole": torch.ones(1)}, {"kind": "toy"})
    refusal = pytest.raises(BadInputError, match=rf"expected finite weights, found NaN or infinity in {name}: ")
    with refusal if is_refused else nullcontext(), understood(path, "a toy", ["toy"], "meta") as (tensors, _):
        assert tensors[name].device.type == "meta"


def test_a_checkpoint_that_is_cut_off_or_runs_code_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    Logbook(path, never).keep({"last": torch.ones(1)})
    whole = path.read_bytes()
    torch.save({"state": Path(), "metadata": "{}"}, path)
    for content in (path.read_bytes(), whole[:-100], b""):
        path.write_bytes(content)
        with pytest.raises(BadInputError, match=rf"^{path} is not a complete checkpoint: remove {tmp_path}$"):
            Logbook(path, never)


def test_the_same_content_comes_back_and_gives_the_same_bytes(tmp_path: Path) -> None:
    whole = torch.arange(6.0).reshape(2, 3)
    tensors = {"whole": whole, "view": whole.T, "step": torch.tensor(3), "mask": torch.tensor([True])}
    metadata = {name: ["ä", 2**70, {"of": name}] for name in "abcdefgh"}
    paths = [tmp_path / f"{number}.safetensors" for number in range(4)]
    for path in paths:
        save_tensors(path, tensors, metadata)
    assert len({path.read_bytes() for path in paths}) == 1
    loaded, loaded_metadata = load_tensors(paths[0])
    assert loaded_metadata == metadata
    assert_same(dict(sorted(loaded.items())), dict(sorted(tensors.items())))


def test_a_network_of_another_size_does_not_go_on(tmp_path: Path) -> None:
    Logbook(tmp_path / "checkpoint.pt", never).keep(nn.Linear(2, 1).state_dict())
    with pytest.raises(BadInputError, match=f"(?s)expected a checkpoint of this version.*: remove {tmp_path}"):
        Logbook(tmp_path / "checkpoint.pt", nn.Linear(3, 1).load_state_dict)


def never(state: dict[str, Any]) -> None:
    raise AssertionError("there was nothing to go on from")


def test_it_goes_on_with_points_time_and_state(tmp_path: Path) -> None:
    checkpoint = tmp_path / "checkpoint.pt"
    first = Logbook(checkpoint, never)
    first.points.append({"steps": 3, "loss": None})
    time.sleep(0.01)
    state = {
        "a": torch.ones(2, 3),
        "list": [1, -0.1, [2.5, None], (torch.zeros(0), True), [{}, [], ()]],
        "state": {0: {"step": torch.tensor(3.0)}, 11: {"step": torch.tensor(4)}},
        "large": [2**70, float("inf"), 1 / 3],
    }
    first.keep(state)
    states: list[dict[str, Any]] = []
    second = Logbook(checkpoint, states.append)
    assert second.points == [{"steps": 3, "loss": None}] and second.stopwatch.seconds > 0.01
    assert_same(states, [state])


def test_a_checkpoint_is_due_a_while_after_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    logbook = Logbook(None, never)
    now[0] += CHECKPOINT_SECONDS - 1.0
    assert not logbook.is_due
    now[0] += 1.0
    assert logbook.is_due
    logbook.keep({})
    assert not logbook.is_due
