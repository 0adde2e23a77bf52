"""HDF5: one dataset per field; the layouts of D4RL, robomimic and d3rlpy are known. Read block by block."""

import json
import math
import re
from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.core.optional import optional
from astra_data.dataset.columns import NEXT_STATE, STATE, TRUNCATED, Array
from astra_data.exchange.hdf5_storage import check_storage, stored_datasets, unpacked_bytes
from astra_data.exchange.layouts import D3RLPY, D4RL, NUMBERED, RECORD, ROBOMIMIC
from astra_data.exchange.mapping import ImportMapping
from astra_data.exchange.recording import BLOCK_ROWS, Block, Source, natural, row_count

SUFFIXES = (".h5", ".hdf5", ".mat")


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the rows of each episode's group, or of the file where `mapping.episodes` is left out.

    Raises:
        BadInputError: groups or fields are missing, or are stored in another file.
    """
    h5py = optional("h5py")
    with h5py.File(source.path, "r") as file:
        for origin, datasets in _episodes(h5py, file, mapping.episodes, str(source)):
            if mapping.episodes is None:
                _refuse_groups(datasets, mapping, origin)
            order = slice(None, None, -1 if mapping.transposed else 1)
            shapes = {name: (dataset.shape or ())[order] for name, dataset in datasets.items()}
            single = [name for name, shape in shapes.items() if not shape and mapping.episodes == NUMBERED]
            rowed = [field for field in mapping.all_fields if field not in single]
            n = row_count(origin, rowed, shapes)
            used = {field: datasets[field] for field in mapping.all_fields}
            check_storage(used, origin)
            source.refuse_beyond(unpacked_bytes(used))
            for first in range(0, n, BLOCK_ROWS):
                rows = slice(first, min(first + BLOCK_ROWS, n))
                values = {
                    field: _at_the_end(dataset[()], rows, n)
                    if field in single
                    else dataset[..., rows].T
                    if mapping.transposed
                    else dataset[rows]
                    for field, dataset in used.items()
                }
                yield Block(values, origin, starts=mapping.episodes is not None and first == 0)


def record(source: Source) -> str | None:
    """Return the record of an export of ours, None if it has none."""
    h5py = optional("h5py")
    with h5py.File(source.path, "r") as file:
        found = file
        for part in RECORD.split("/"):
            is_here = isinstance(found, h5py.Group) and part in found
            if not is_here or not isinstance(found.get(part, getlink=True), h5py.HardLink):
                return None
            found = found[part]
        is_text = isinstance(found, h5py.Dataset) and h5py.check_string_dtype(found.dtype) is not None
        return str(found.asstr()[()]) if is_text and found.shape == () else None


def layout(source: Source) -> dict[str, Any]:
    """Return the keys of a mapping for a file in the layout of D4RL, d3rlpy or robomimic.

    Of robomimic, the state is all of `obs` with one or two dimensions (images are left out), in the order of
    their names; `dones` is taken as terminated, as robomimic's own learners do. It may stay set while
    success lasts: rows after its first are episodes of one step, left out unless truncation is recorded too.

    Raises:
        BadInputError: it is none of them.
    """
    h5py = optional("h5py")
    with h5py.File(source.path, "r") as file:
        fields = stored_datasets(h5py, file)
        if {"observations", "actions"} <= fields.keys():
            columns = {name: {"fields": [field]} for name, field in D4RL.items() if field in fields}
            return {"columns": columns}
        if {"num_episodes", "observations_0", "actions_0"} <= fields.keys():
            columns = {name: {"fields": [field]} for name, field in D3RLPY.items() if f"{field}_0" in fields}
            return {"columns": columns, "episodes": NUMBERED}
        demos = sorted({name.split("/")[1] for name in fields if name.startswith("data/demo_")}, key=natural)
        if not demos:
            raise BadInputError(
                f"{source}: neither D4RL's layout (observations, actions) nor d3rlpy's (observations_0) nor "
                "robomimic's (data/demo_0); pass --mapping"
            )
        demo = stored_datasets(h5py, file[f"data/{demos[0]}"])
        columns = {name: {"fields": [field]} for name, field in ROBOMIMIC.items() if field in demo}
        for name, folder in ((STATE, "obs/"), (NEXT_STATE, "next_obs/")):
            found = [field for field, d in demo.items() if field.startswith(folder) and d.ndim in (1, 2)]
            if found:
                columns[name] = {"fields": sorted(found), "names": _labels(demo, sorted(found))}
        keys: dict[str, Any] = {"columns": columns, "episodes": "data/demo_*"}
        if TRUNCATED not in columns:
            keys["min_steps"] = 2
        env_args = json.loads(file["data"].attrs.get("env_args", "{}"))
        fps = env_args.get("env_kwargs", {}).get("control_freq")
        return keys | ({"fps": int(fps)} if fps and fps == int(fps) else {})


def _labels(demo: dict[str, Any], fields: list[str]) -> list[str]:
    """Return a name for each value of the fields of `obs`, such as tilt, pos_0 and pos_1."""
    widths = {field: math.prod(demo[field].shape[1:]) for field in fields}
    return [
        field.split("/", 1)[1] + (f"_{number}" if width > 1 else "")
        for field, width in widths.items()
        for number in range(width)
    ]


def _refuse_groups(stored: dict[str, Any], mapping: ImportMapping, origin: str) -> None:
    """Raise BadInputError where the fields are not in the file itself, but all in each of some groups."""
    groups = {name.removesuffix(f"/{field}") for field in mapping.all_fields for name in stored} - {*stored}
    whole = [group for group in groups if all(f"{group}/{field}" in stored for field in mapping.all_fields)]
    if whole and not stored.keys() & set(mapping.all_fields):
        first = min(whole, key=natural)
        pattern = re.sub("[0-9]+", "*", first)
        raise BadInputError(
            f"{origin}: the fields are in {len(whole)} groups, such as {first}: give the mapping episodes = "
            f'"{pattern}", and each is an episode'
        )


def _episodes(
    h5py: Any,  # noqa: ANN401 - a module
    file: Any,  # noqa: ANN401 - of h5py
    pattern: str | None,
    origin: str,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name of each episode's part of the file and its fields."""
    if pattern != NUMBERED:
        for group in _groups(h5py, file, pattern, origin):
            yield f"{origin}{group.name}".rstrip("/"), stored_datasets(h5py, group)
        return
    numbered: dict[int, dict[str, Any]] = {}
    for name, dataset in stored_datasets(h5py, file).items():
        if found := re.fullmatch(r"(.+)_([0-9]+)", name):
            numbered.setdefault(int(found[2]), {})[found[1]] = dataset
    for number in sorted(numbered):
        yield f"{origin}/{number}", numbered[number]


def _at_the_end(value: Array, rows: slice, n: int) -> Array:
    """Return the values of `rows` of n: `value` in the last, and 0 before it."""
    values = np.zeros(n, np.asarray(value).dtype)
    values[-1] = value
    return values[rows]


def _groups(h5py: Any, file: Any, pattern: str | None, origin: str) -> list[Any]:  # noqa: ANN401 - of h5py
    groups = [file]
    if pattern is None:
        return groups
    for part in pattern.strip("/").split("/"):
        groups = [
            _linked(h5py, group, name, origin)
            for group in groups
            for name in sorted(group, key=natural)
            if fnmatchcase(name, part)
        ]
    if not groups:
        raise BadInputError(f"{origin}: no groups '{pattern}'; it has {', '.join(list(file)[:10])}")
    return groups


def _linked(h5py: Any, group: Any, name: str, origin: str) -> Any:  # noqa: ANN401 - of h5py
    """Return the group `name` of `group`; links are refused, since they may lead to another file."""
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise BadInputError(
            f"{origin}{group.name.rstrip('/')}/{name} is a link; replace it by a copy of its target"
        )
    return group[name]
