"""The seal of a dataset: "sums" in meta/astra/dataset.json, the sha256 of its small files and of itself.

The values of the data files are not among them: they have their own digests.
"""

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from astra_data.core.digest import file_digest
from astra_data.dataset import format as layout
from astra_data.dataset.plain import episodes_files

_EPISODES = re.compile(r"meta/episodes/[\w-]+/[\w-]+\.parquet")
SEALED = (
    layout.INFO_PATH,
    layout.STATS_PATH,
    layout.TASKS_PATH,
    layout.METADATA_PATH,
    layout.SUBSETS_PATH,
    layout.DIGESTS_PATH,
)
"""The files with a sum, beside the description and those of meta/episodes."""


def sealed(root: Path, description: Mapping[str, Any]) -> dict[str, Any]:
    """Return `description`, as JSON gives it back, with the sums of the files in folder `root`."""
    sums = {path: file_digest(root / path) for path in (*SEALED, *_episodes(root))}
    full: dict[str, Any] = json.loads(json.dumps({**description, "sums": sums}))
    full["sums"][layout.DATASET_PATH] = _own_sum(full)
    return full


def is_description_sealed(description: Mapping[str, Any]) -> bool:
    """Return whether `description` is as it was sealed."""
    return bool(description["sums"].get(layout.DATASET_PATH) == _own_sum(description))


def is_sealed(path: Path, expected: str | None) -> bool:
    """Return whether the file at `path` has the sum `expected`."""
    return path.is_file() and file_digest(path) == expected


def altered_files(root: Path, description: Mapping[str, Any]) -> Iterator[str]:
    """Yield the sealed files in folder `root` that were altered or are missing, and those added to them."""
    sums = description.get("sums", {})
    listed = [path for path in sums if _EPISODES.fullmatch(path)]
    for path in (*(path for path in SEALED if path in sums), *sorted({*listed, *_episodes(root)})):
        if sums and not is_sealed(root / path, sums.get(path)):
            yield path


def _episodes(root: Path) -> list[str]:
    return [path.relative_to(root).as_posix() for path in episodes_files(root)]


def _own_sum(description: Mapping[str, Any]) -> str:
    sums = {path: value for path, value in description["sums"].items() if path != layout.DATASET_PATH}
    text = json.dumps({**description, "sums": sums}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
