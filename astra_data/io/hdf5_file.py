"""HDF5 files of other libraries: the names of our columns there, and what a file really holds.

A file by a stranger may point elsewhere, or claim more than there is.
"""

from collections.abc import Mapping
from math import prod
from typing import Any

import numpy as np

from astra_data.core.errors import BadInputError, optional
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED

D4RL = {STATE: "observations", ACTION: "actions", REWARD: "rewards", TERMINATED: "terminals", TRUNCATED: "timeouts"}
D4RL |= {NEXT_STATE: "next_observations", GOAL: "infos/goal"}
ROBOMIMIC = {ACTION: "actions", REWARD: "rewards", TERMINATED: "dones", TRUNCATED: "truncated"}
"""Per demonstration; its learners take `dones` for terminated, and `truncated` is ours."""
D3RLPY = {STATE: "observations", ACTION: "actions", REWARD: "rewards", TERMINATED: "terminated"}
"""Per episode, with its number at the end of the name; `terminated` is a single value."""
MINARI = {ACTION: "actions", REWARD: "rewards", TERMINATED: "terminations", TRUNCATED: "truncations"}
NUMBERED = "{field}_{number}"  # the pattern of episodes whose fields end with the number of the episode

MOST_COMPRESSED = 10_000  # larger than the compression ratio of any filter; beyond it, the values were never written


def stored_datasets(group: Any) -> dict[str, Any]:
    """Map the path of each dataset below `group` to it; links into other files are not followed."""
    found, kind = dict[str, Any](), optional("h5py").Dataset
    group.visititems(lambda name, item: found.update({name: item} if isinstance(item, kind) else {}))
    return found


def refuse_links(file: Any, origin: str) -> None:
    """Raise BadInputError if a file has links, which may lead into other files."""
    links, plain = list[str](), optional("h5py").HardLink
    file.visititems_links(lambda name, link: links.extend([] if isinstance(link, plain) else [name]))
    if links:
        listed = ", ".join(links[:10])
        raise BadInputError(f"{origin}: {listed}: expected no links; replace each by a copy of its target")


def check_storage(datasets: Mapping[str, Any], origin: str) -> None:
    """Raise BadInputError unless all `datasets` are in their own file, as large as claimed, and written."""
    faults = []
    for field, dataset in datasets.items():
        if dataset.external or dataset.is_virtual:
            faults.append(f"field '{field}' lies in another file; copy it into this one")
        elif dataset.nbytes > MOST_COMPRESSED * (dataset.id.get_storage_size() + 2**10):
            faults.append(f"field '{field}' claims the shape {dataset.shape}, but the file does not hold it")
        elif not _is_written(dataset):
            faults.append(f"field '{field}' was not written as a whole: what is missing reads as 0")
    if faults:
        raise BadInputError(f"{origin}: {'; '.join(faults)}")


def _is_written(dataset: Any) -> bool:
    """Return whether all values are in the file; others would be read as the fill value."""
    if dataset.chunks is None:
        return bool(dataset.size == 0 or dataset.id.get_storage_size() > 0)
    wanted = prod(-(-length // chunk) for length, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    return bool(dataset.id.get_num_chunks() >= wanted)


def unpacked_bytes(datasets: Mapping[str, Any]) -> int:
    """Return how many bytes are read with all `datasets`; a chunk is unpacked whole, however few its rows."""
    chunks = {name: int(np.prod(d.chunks or (0,), dtype=object)) for name, d in datasets.items()}
    return sum(max(int(d.nbytes), chunks[name] * d.dtype.itemsize) for name, d in datasets.items())
