import re

import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.core.provenance import cores
from astra_data.pipeline.devices import check_device, default_jobs, share_cores
from astra_data.pipeline.executors import Item

OTHERS = ("mps", "meta", "xpu:0")
"""Devices that torch knows, and trainings do not."""


def threads(num_threads: int = 1) -> int:
    return num_threads


def items(*keys: str) -> list[Item]:
    return [Item(key, (), threads, is_threaded=key.startswith("collect")) for key in keys]


def test_an_item_for_each_core_or_two_on_a_cuda_device() -> None:
    assert default_jobs("cpu") == cores()
    assert default_jobs("cuda:1") == 2


def test_items_that_step_physics_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("astra_data.pipeline.devices.cores", lambda: 8)
    two = items("collect/seed_0", "collect/seed_1", "train/nas/seed_0")
    assert [item.call() for item in share_cores(two, 4)] == [4, 4, 1]
    assert [item.call() for item in share_cores(two[1:], 4)] == [8, 1]
    many = items(*(f"collect/seed_{seed}" for seed in range(20)))
    assert {item.call() for item in share_cores(many, 16)} == {1}
    assert {item.call() for item in share_cores(many, 2)} == {4}


@pytest.mark.parametrize(
    ("device", "cluster", "expected"),
    [
        ("gpu", None, "expected a device such as cpu, cuda or cuda:1, got 'gpu'"),
        *((kind, None, f"expected a device such as cpu, cuda or cuda:1, got '{kind}'") for kind in OTHERS),
        ("mps", "local", "expected a device such as cpu, cuda or cuda:1, got 'mps'"),
        ("cuda:7", None, "device 'cuda:7' is not available: torch finds 1 CUDA devices"),
        ("cuda:1", "local", "expected device cpu or cuda on a cluster, got 'cuda:1'"),
    ],
)
def test_a_device_that_is_not_there_is_told(
    monkeypatch: pytest.MonkeyPatch, device: str, cluster: str | None, expected: str
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(BadInputError, match=re.escape(expected)):
        check_device(device, cluster)


def test_without_a_gpu_there_is_no_first_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with pytest.raises(BadInputError, match="device 'cuda' is not available: torch finds 0 CUDA devices"):
        check_device("cuda", None)
    check_device("cpu", None)


def test_devices_that_are_there_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    for device, cluster in (("cpu", None), ("cuda", None), ("cuda:0", None), ("cuda", "local")):
        check_device(device, cluster)
