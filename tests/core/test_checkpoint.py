import errno
import os
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import torch
from failing_disk import failing
from safetensors.torch import save_file
from torch import Tensor, nn

from astra_data.core.checkpoint import (
    finished_folder,
    flatten,
    load_tensors,
    save_tensors,
    understood,
    unflatten,
)
from astra_data.core.errors import BadInputError, DiskError


def assert_same(actual: object, expected: object) -> None:
    assert type(actual) is type(expected)
    if isinstance(expected, Tensor):
        assert torch.equal(torch.as_tensor(actual), expected)
    elif isinstance(expected, Mapping):
        assert isinstance(actual, Mapping)
        assert list(actual) == list(expected)
        for key in expected:
            assert_same(actual[key], expected[key])
    elif isinstance(expected, list | tuple):
        assert isinstance(actual, list | tuple)
        assert len(actual) == len(expected)
        for one, other in zip(actual, expected, strict=True):
            assert_same(one, other)
    else:
        assert actual == expected


def test_tensors_and_metadata_come_back(tmp_path: Path) -> None:
    whole = torch.arange(6.0).reshape(2, 3)
    tensors = {"whole": whole, "view": whole.T, "step": torch.tensor(3), "mask": torch.tensor([True])}
    metadata = {"config": {"sizes": [8, 8], "rate": 0.1}, "steps": 2**70, "name": "ä"}
    save_tensors(tmp_path / "a.safetensors", tensors, metadata)
    loaded, loaded_metadata = load_tensors(tmp_path / "a.safetensors")
    assert loaded_metadata == metadata
    assert_same(dict(sorted(loaded.items())), dict(sorted(tensors.items())))


def test_a_failed_save_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    save_tensors(path, {"a": torch.ones(1)}, {})
    with pytest.raises(TypeError):
        save_tensors(path, {"a": torch.zeros(1)}, {"not JSON": {1, 2}})
    assert load_tensors(path)[0]["a"] == 1
    assert [file.name for file in tmp_path.iterdir()] == ["a.safetensors"]


def test_nothing_is_not_saved(tmp_path: Path) -> None:
    assert unflatten(flatten({})) == {}
    with pytest.raises(BadInputError, match="at least one tensor"):
        save_tensors(tmp_path / "a.safetensors", {}, {})


def test_files_that_are_missing_damaged_or_foreign_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    with pytest.raises(BadInputError, match="does not exist"):
        load_tensors(path)
    save_tensors(path, {"a": torch.ones(100)}, {})
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(BadInputError, match="not a whole safetensors file"):
        load_tensors(path)
    save_file({"a": torch.ones(1)}, path, {"format": "pt"})
    with pytest.raises(BadInputError, match="not written by astra-data"):
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
def test_weights_that_are_not_finite_are_refused(
    tmp_path: Path, name: str, value: float, is_refused: bool
) -> None:
    path = tmp_path / "a.safetensors"
    save_tensors(path, {name: torch.tensor([1.0, value]), "whole": torch.ones(1)}, {"kind": "toy"})
    refusal = pytest.raises(
        BadInputError, match=rf"expected finite weights, found NaN or infinity in {name}: "
    )
    with refusal if is_refused else nullcontext(), understood(path, "a toy", ["toy"], "cpu") as (tensors, _):
        assert tensors[name][0] == 1


@pytest.mark.parametrize(
    "nested",
    [
        {"a": torch.ones(2, 3), "b.c": 1, "d": -0.1, "e": True, "f": None},
        {"empty": [{}, [], ()], "list": [1, [2.5, None], (torch.zeros(0),)], "tuple": ()},
        {"state": {0: {"step": torch.tensor(3.0)}, 11: {"step": torch.tensor(4)}}, "0": {-1: False}},
        {"long": list(range(12))},
    ],
)
def test_nested_states_come_back(nested: dict[Any, Any], tmp_path: Path) -> None:
    flat = flatten(nested)
    assert all(isinstance(tensor, Tensor) for tensor in flat.values())
    assert_same(unflatten(flat), nested)
    save_tensors(tmp_path / "state.safetensors", flat, {})
    loaded, _ = load_tensors(tmp_path / "state.safetensors")
    assert_same(unflatten({path: loaded[path] for path in flat}), nested)


@pytest.mark.parametrize(
    "nested", [{"a/b": 1}, {"": 1}, {"#1": 1}, {("a",): 1}, {"a": {True: 1}}, {"a": "text"}]
)
def test_what_cannot_come_back_is_refused(nested: dict[Any, Any]) -> None:
    with pytest.raises(BadInputError, match="expected"):
        flatten(nested)


def _train(network: nn.Module, optimizer: torch.optim.Optimizer, steps: int) -> None:
    for step in range(steps):
        optimizer.zero_grad()
        loss: Tensor = (network(torch.full((4, 3), float(step))) ** 2).sum()
        loss.backward()
        optimizer.step()


def _network() -> tuple[nn.Module, torch.optim.Optimizer]:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 3), nn.Linear(3, 1))
    return network, torch.optim.AdamW(network.parameters(), betas=(0.8, 0.9))


def test_a_resumed_training_equals_one_that_was_never_interrupted(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    network, optimizer = _network()
    _train(network, optimizer, 3)
    save_tensors(path, flatten({"network": network.state_dict(), "optimizer": optimizer.state_dict()}), {})
    _train(network, optimizer, 3)

    resumed, resumed_optimizer = _network()
    state = unflatten(load_tensors(path)[0])
    assert_same(state["optimizer"]["param_groups"][0]["betas"], (0.8, 0.9))
    resumed.load_state_dict(state["network"])
    resumed_optimizer.load_state_dict(state["optimizer"])
    _train(resumed, resumed_optimizer, 3)
    assert_same(dict(resumed.state_dict()), dict(network.state_dict()))


def test_a_folder_appears_when_it_is_finished(tmp_path: Path) -> None:
    out = tmp_path / "train" / "seed_0"
    with finished_folder(out) as folder:
        (folder / "a").touch()
        assert not out.exists()
        assert folder == tmp_path / "train" / ".seed_0.partial"
    assert [path.name for path in out.iterdir()] == ["a"]
    assert not folder.exists()


def test_an_interrupted_folder_is_found_again(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), finished_folder(tmp_path / "out") as folder:
        (folder / "checkpoint").touch()
        raise KeyboardInterrupt
    assert not (tmp_path / "out").exists()
    with finished_folder(tmp_path / "out") as folder:
        assert (folder / "checkpoint").exists()


def test_a_folder_begun_with_another_config_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt), finished_folder(out, config="1") as folder:
        (folder / "checkpoint").touch()
        raise KeyboardInterrupt
    with (
        pytest.raises(BadInputError, match=f"{folder} was begun with other settings"),
        finished_folder(out, config="2"),
    ):
        pass
    with finished_folder(out, config="1"):
        pass
    made = sorted((path.name, path.read_text()) for path in out.iterdir())
    assert made == [("checkpoint", ""), ("config.json", "1")]


@pytest.mark.parametrize("config", [None, "1"])
@pytest.mark.parametrize("error", [BadInputError("no episodes"), KeyboardInterrupt()])
def test_a_failure_before_anything_is_made_leaves_nothing(
    tmp_path: Path, config: str | None, error: BaseException
) -> None:
    (tmp_path / "train").mkdir()
    with (
        pytest.raises(type(error)),
        finished_folder(tmp_path / "train" / "astra" / "seed_0", config=config),
    ):
        raise error
    assert [path.name for path in tmp_path.rglob("*")] == ["train"]


def test_the_folder_of_another_that_is_under_way_stays(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with (
        finished_folder(out, config="1"),
        pytest.raises(BadInputError, match="no episodes"),
        finished_folder(out, config="1"),
    ):
        raise BadInputError("no episodes")
    assert (out / "config.json").read_text() == "1"


def test_a_folder_that_is_gone_hides_no_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="the true error"), finished_folder(tmp_path / "out") as folder:
        folder.rmdir()
        raise ValueError("the true error")


def test_a_folder_begun_without_a_config_is_refused(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), finished_folder(tmp_path / "out") as folder:
        (folder / "checkpoint").touch()
        raise KeyboardInterrupt
    with (
        pytest.raises(BadInputError, match="begun with other"),
        finished_folder(tmp_path / "out", config="1"),
    ):
        pass
    assert [path.name for path in folder.iterdir()] == ["checkpoint"]


def test_a_finished_folder_is_replaced_only_on_request(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").touch()
    with pytest.raises(BadInputError, match="finished already"), finished_folder(tmp_path / "out"):
        pass
    with finished_folder(tmp_path / "out", replace=True) as folder:
        (folder / "new").touch()
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == [
        "out",
        "out/new",
    ]


def test_a_failed_replacement_leaves_the_old_folder_and_is_not_gone_on_with(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").touch()
    with pytest.raises(KeyboardInterrupt), finished_folder(tmp_path / "out", replace=True) as folder:
        (folder / "half").touch()
        raise KeyboardInterrupt
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["old"]
    with finished_folder(tmp_path / "out", replace=True) as folder:
        assert not list(folder.iterdir())


@pytest.mark.parametrize("renames", [0, 1, 2])
def test_a_kill_while_replacing_loses_nothing(
    tmp_path: Path, renames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, left = tmp_path / "out", [renames]

    def replace_until_killed(source: Path, target: Path) -> None:
        if not left[0]:
            raise KeyboardInterrupt
        left[0] -= 1
        source.rename(target)

    def killed(_: Path) -> None:
        raise KeyboardInterrupt

    out.mkdir()
    (out / "old").touch()
    with monkeypatch.context() as patched:
        patched.setattr("os.replace", replace_until_killed)
        patched.setattr("shutil.rmtree", killed)
        with pytest.raises(KeyboardInterrupt), finished_folder(out, replace=True) as folder:
            (folder / "new").touch()
    with pytest.raises(BadInputError, match="finished already"), finished_folder(out):
        pass
    assert [path.name for path in out.iterdir()] == ["new" if renames == 2 else "old"]
    with finished_folder(out, replace=True) as folder:
        (folder / "newer").touch()
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == [
        "out",
        "out/newer",
    ]


def test_the_same_content_gives_the_same_bytes(tmp_path: Path) -> None:
    metadata = {name: ["ä", {"of": name}] for name in "abcdefgh"}
    paths = [tmp_path / f"{number}.safetensors" for number in range(4)]
    for path in paths:
        save_tensors(path, {"x": torch.arange(3.0), "y": torch.ones(2, 2)}, metadata)
    assert len({path.read_bytes() for path in paths}) == 1
    assert load_tensors(paths[0])[1] == metadata


@pytest.mark.usefixtures("fsync")
def test_a_disk_that_fails_at_any_operation_leaves_a_folder_to_go_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda handle: None)

    def make(out: Path) -> None:
        with finished_folder(out, config="1") as folder:
            save_tensors(folder / "model.safetensors", {"weight": torch.ones(2)}, {})

    make(tmp_path / "whole")
    whole = {path.name: path.read_bytes() for path in (tmp_path / "whole").iterdir()}
    for at in count():
        out = tmp_path / f"at_{at}" / "out"
        with failing("mkdir rename replace unlink rmdir fsync", at, OSError(errno.ENOSPC, "")) as calls:
            try:
                make(out)
            except DiskError as error:
                assert "cannot be written: the disk is full" in str(error)
        if not out.exists():
            make(out)
        assert {path.name: path.read_bytes() for path in out.iterdir()} == whole
        if len(calls) <= at:
            break
    assert at > 15


def test_a_disk_that_fails_while_a_folder_is_replaced_leaves_the_old_one_or_the_new_one(
    tmp_path: Path,
) -> None:
    out = tmp_path / "out"
    (out / "first").mkdir(parents=True)
    for at in count():
        with (
            failing("rename replace", at, OSError(errno.EIO, "fault")) as calls,
            suppress(DiskError),
            finished_folder(out, replace=True) as folder,
        ):
            (folder / f"{at}").touch()
        assert len(list(out.iterdir())) == 1
        if len(calls) <= at:
            break
    assert [path.name for path in out.iterdir()] == [str(at)]
    assert at > 1


def test_what_a_kill_left_in_the_working_folder_is_not_published(tmp_path: Path) -> None:
    partial = tmp_path / ".out.partial"
    (partial / ".checkpoint.safetensors.tmp-7").mkdir(parents=True)
    (partial / ".model.safetensors.partial").touch()
    with finished_folder(tmp_path / "out", config="1") as folder:
        (folder / "model").touch()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["config.json", "model"]
