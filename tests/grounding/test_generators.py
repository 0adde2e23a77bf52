from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch

from astra_data.grounding.descent import seeded

CPU, GPU = torch.device("cpu"), torch.device("cuda:1")


@pytest.fixture
def on_gpus(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Note what is asked of a CUDA device that is not there."""
    noted: list[object] = []

    @contextmanager
    def device(asked: torch.device) -> Iterator[None]:
        noted.append(asked)
        yield

    monkeypatch.setattr(torch.cuda, "device", device)
    for name in ("manual_seed", "manual_seed_all", "get_rng_state"):
        monkeypatch.setattr(torch.cuda, name, noted.append)
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda state, device: noted.append((state, device)))
    return noted


def test_in_a_block_draws_are_from_its_seed_and_go_on_afterwards() -> None:
    torch.manual_seed(1)
    first, second = torch.rand(5), torch.rand(5)
    torch.manual_seed(1)
    assert torch.equal(torch.rand(5), first)
    with seeded(1, CPU):
        assert torch.equal(torch.rand(5), first)
    assert torch.equal(torch.rand(5), second)


def test_the_generator_of_the_device_in_use_is_seeded_and_put_back(on_gpus: list[object]) -> None:
    with seeded(3, GPU):
        assert on_gpus == [GPU, GPU, 3]
    assert on_gpus[3:] == [(None, GPU)]
