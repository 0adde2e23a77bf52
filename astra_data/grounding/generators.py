"""Seed torch's global generators of the devices in use, and no others; `torch.manual_seed` seeds all."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


def seed_generators(seed: int, device: torch.device) -> None:
    """Seed torch's generators of the CPU and `device`; `torch.manual_seed` takes ten times as long."""
    torch.default_generator.manual_seed(seed)
    if device.type == "cuda":
        with torch.cuda.device(device):
            torch.cuda.manual_seed(seed)


@contextmanager
def seeded(seed: int, device: torch.device) -> Iterator[None]:
    """Draw on the CPU and `device` from `seed` in the block; afterwards, draws go on as before it."""
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        seed_generators(seed, device)
        yield
