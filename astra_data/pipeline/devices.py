"""How many items of a run are made at a time, on which device, and with how many cores each."""

from collections import Counter
from collections.abc import Collection
from dataclasses import replace
from functools import partial

import torch

from astra_data.core.errors import BadInputError
from astra_data.core.provenance import cores
from astra_data.pipeline.executors import Item
from astra_data.pipeline.plan import stage_of

CUDA_JOBS = 2
"""Items at a time on a CUDA device, where each process has its own context."""


def check_device(device: str, cluster: str | None) -> None:
    """Check that the CPU or a CUDA device is available, or may be on the cluster at an address.

    Raises:
        BadInputError: it is not.
    """
    try:
        wanted = torch.device(device)
    except RuntimeError:
        wanted = None
    if wanted is None or wanted.type not in {"cpu", "cuda"}:
        raise BadInputError(f"expected a device such as cpu, cuda or cuda:1, got '{device}'")
    if cluster is not None:
        # Ray gives each task its own GPU, which is the only one that it sees.
        if wanted.index:
            raise BadInputError(f"expected device cpu or cuda on a cluster, got '{device}'")
        return
    count = torch.cuda.device_count()
    if wanted.type == "cuda" and (wanted.index or 0) >= count:
        raise BadInputError(f"device '{device}' is not available: torch finds {count} CUDA devices")


def default_jobs(device: str) -> int:
    """Return how many items are made at a time: one per core, or `CUDA_JOBS` on a CUDA device."""
    return CUDA_JOBS if torch.device(device).type == "cuda" else cores()


def share_cores(items: Collection[Item], jobs: int) -> list[Item]:
    """Give the items that step the target's physics their share of the cores."""
    counts = Counter(map(stage_of, items))
    return [with_threads(item, max(1, cores() // min(jobs, counts[stage_of(item)]))) for item in items]


def with_threads(item: Item, num_threads: int) -> Item:
    """Return `item`, to be made by `num_threads` threads if it steps the target's physics."""
    if not item.is_threaded:
        return item
    return replace(item, call=partial(item.call, num_threads=num_threads))
