"""HDF5: one dataset per field; the layouts of D4RL and robomimic are known. Read block by block."""

import json
from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from typing import Any

from astra_data.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED
from astra_data.errors import BadInputError
from astra_data.import_mapping import ImportMapping
from astra_data.recording import BLOCK_ROWS, Block, Source, natural, optional, row_count

SUFFIXES = (".h5", ".hdf5", ".mat")

D4RL = {
    STATE: "observations",
    ACTION: "actions",
    REWARD: "rewards",
    TERMINATED: "terminals",
    TRUNCATED: "timeouts",
    NEXT_STATE: "next_observations",
    GOAL: "infos/goal",
}
MOST_COMPRESSED = 10_000
"""No filter makes this many bytes of one; beyond, values were never written."""
ROBOMIMIC = {ACTION: "actions", REWARD: "rewards", TERMINATED: "dones"}


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the rows of each episode's group, or of the file where `mapping.episodes` is left out.

    Raises:
        BadInputError: groups or fields are missing, or lie in another file.
    """
    h5py = optional("h5py", "hdf5")
    with h5py.File(source.path, "r") as file:
        for group in _groups(file, mapping.episodes, str(source)):
            origin = f"{source}{group.name}".rstrip("/")
            datasets = _datasets(h5py, group)
            order = slice(None, None, -1 if mapping.transposed else 1)
            shapes = {name: (dataset.shape or ())[order] for name, dataset in datasets.items()}
            n = row_count(origin, mapping.all_fields, shapes)
            used = {field: datasets[field] for field in mapping.all_fields}
            _check_storage(used, origin)
            for first in range(0, n, BLOCK_ROWS):
                rows = slice(first, min(first + BLOCK_ROWS, n))
                values = {
                    field: dataset[..., rows].T if mapping.transposed else dataset[rows]
                    for field, dataset in used.items()
                }
                yield Block(values, origin, starts=mapping.episodes is not None and first == 0)


def layout(source: Source) -> dict[str, Any]:
    """Return the keys of a mapping for a file in the layout of D4RL or of robomimic.

    Of robomimic, the state is all of `obs` with one or two dimensions (images are left out), in the order of
    their names; `dones` is taken for terminated, as robomimic's own learners do.

    Raises:
        BadInputError: it is neither.
    """
    h5py = optional("h5py", "hdf5")
    with h5py.File(source.path, "r") as file:
        fields = _datasets(h5py, file)
        if {"observations", "actions"} <= fields.keys():
            columns = {name: {"fields": [field]} for name, field in D4RL.items() if field in fields}
            ends = [field for field in ("terminals", "timeouts") if field in fields]
            return {"columns": columns, "split": {"ends": ends}}
        demos = sorted({name.split("/")[1] for name in fields if name.startswith("data/demo_")}, key=natural)
        if not demos:
            raise BadInputError(
                f"{source}: neither D4RL's layout (observations, actions) nor robomimic's (data/demo_0); "
                "pass --mapping"
            )
        demo = _datasets(h5py, file[f"data/{demos[0]}"])
        columns = {name: {"fields": [field]} for name, field in ROBOMIMIC.items() if field in demo}
        for name, folder in ((STATE, "obs/"), (NEXT_STATE, "next_obs/")):
            found = [field for field, d in demo.items() if field.startswith(folder) and d.ndim in (1, 2)]
            if found:
                columns[name] = {"fields": sorted(found)}
        keys: dict[str, Any] = {"columns": columns, "episodes": "data/demo_*"}
        env_args = json.loads(file["data"].attrs.get("env_args", "{}"))
        fps = env_args.get("env_kwargs", {}).get("control_freq")
        return keys | ({"fps": int(fps)} if fps and fps == int(fps) else {})


def _groups(file: Any, pattern: str | None, origin: str) -> list[Any]:  # noqa: ANN401 - of h5py
    if pattern is None:
        return [file]
    folder, _, names = pattern.rpartition("/")
    parent = file.get(folder) if folder else file
    found = sorted((name for name in parent or () if fnmatchcase(name, names)), key=natural)
    if not found:
        raise BadInputError(f"{origin}: no groups '{pattern}'; it has {', '.join(list(file)[:10])}")
    return [parent[name] for name in found]


def _check_storage(datasets: Mapping[str, Any], origin: str) -> None:
    faults = []
    for field, dataset in datasets.items():
        if dataset.external or dataset.is_virtual:
            faults.append(f"field '{field}' lies in another file; copy it into this one")
        elif dataset.nbytes > MOST_COMPRESSED * (dataset.id.get_storage_size() + 2**10):
            faults.append(f"field '{field}' claims the shape {dataset.shape}, but the file does not hold it")
    if faults:
        raise BadInputError(f"{origin}: {'; '.join(faults)}")


def _datasets(h5py: Any, group: Any) -> dict[str, Any]:  # noqa: ANN401 - of h5py
    """Map the path of each dataset below `group` to it; links into other files are not followed."""
    found: dict[str, Any] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            found[name] = item

    group.visititems(visit)
    return found
