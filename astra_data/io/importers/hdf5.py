"""HDF5: one dataset per field; the layouts of D4RL, robomimic and d3rlpy are known."""

import json
import math
import re
from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from astra_data.core.errors import BadInputError, optional
from astra_data.dataset.columns import NEXT_STATE, STATE, SUCCESS, TRUNCATED
from astra_data.io.hdf5_file import D3RLPY, D4RL, NUMBERED, ROBOMIMIC, check_storage, stored_datasets, unpacked_bytes
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import Block, Source, natural, row_count

SUFFIXES = (".h5", ".hdf5", ".mat")
_COMMANDS = re.compile(r"(?<![a-z])actions?(?![a-z])")  # observations that are, or were, commands


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the rows of each episode's group, or of the file where `mapping.episodes` is left out."""
    with _opened(source) as file:
        for origin, datasets, attributes in _episodes(file, mapping.episodes, str(source)):
            with source.tolerant():
                yield from _blocks(source, mapping, origin, datasets, attributes)


def _blocks(
    source: Source, mapping: ImportMapping, origin: str, datasets: dict[str, Any], attributes: dict[str, Any]
) -> Iterator[Block]:
    stored, wanted = datasets.keys(), mapping.all_fields
    groups = {name.removesuffix(f"/{field}") for field in wanted for name in stored} - stored
    whole = [group for group in groups if all(f"{group}/{field}" in stored for field in wanted)]
    if mapping.episodes is None and whole and not stored & set(wanted):
        pattern = re.sub("[0-9]+", "*", first := min(whole, key=natural))
        advice = f'give the mapping episodes = "{pattern}", and each is an episode'
        raise BadInputError(f"{origin}: the fields are in {len(whole)} groups, such as {first}: {advice}")
    order = slice(None, None, -1 if mapping.transposed else 1)
    shapes = {name: (dataset.shape or ())[order] for name, dataset in datasets.items()}
    single = {name: datasets[name] for name, shape in shapes.items() if not shape} | attributes
    of_episodes = single if mapping.episodes else {}
    rowed = [field for field in mapping.all_fields if field not in of_episodes]
    n = row_count(origin, rowed, shapes)
    used = {field: datasets[field] for field in rowed}
    ends = {field: np.asarray(of_episodes[field][()]) for field in mapping.all_fields if field not in used}
    known = [name for name, shape in shapes.items() if shape]
    check_storage(used, origin)
    source.refuse_beyond(unpacked_bytes(used))
    if n:
        values = {field: dataset[()].T if mapping.transposed else dataset[()] for field, dataset in used.items()}
        for field in ends:  # in the last row, and 0 before it
            values[field] = np.zeros((n, *ends[field].shape), ends[field].dtype)
            values[field][-1] = ends[field]
        yield Block(values, origin, starts=mapping.episodes is not None, known=known)


def _opened(source: Source) -> Any:
    with source.open() as stream:
        if stream.read(10) == b"MATLAB 5.0":
            raise BadInputError(
                f"{source} is of MATLAB's format 5, expected 7.3, which is HDF5: in MATLAB, load it and "
                "save('NEW.mat', '-v7.3'); in Python, save the arrays of scipy.io.loadmat by numpy.savez"
            )
    return optional("h5py").File(source.path, "r")


def layout(source: Source) -> dict[str, Any]:
    """Return the keys of a mapping for a file in the layout of D4RL, d3rlpy or robomimic.

    Of robomimic, the state is all of `obs` with one or two dimensions but actions, in the order of their names; `dones`
    is taken as terminated, as its own learners do; the attribute `success` is that of a demonstration's last step.
    """
    with _opened(source) as file:
        fields = stored_datasets(file)
        if {"observations", "actions"} <= fields.keys():
            columns = {name: {"fields": [field]} for name, field in D4RL.items() if field in fields}
            stacked = {fields[field].shape[:2] for field in ("observations", "actions")}
            return {"columns": columns, "stacked": len(stacked) == 1 and fields["actions"].ndim == 3}
        if {"num_episodes", "observations_0", "actions_0"} <= fields.keys():
            columns = {name: {"fields": [field]} for name, field in D3RLPY.items() if f"{field}_0" in fields}
            return {"columns": columns, "episodes": NUMBERED}
        demos = sorted({name.split("/")[1] for name in fields if name.startswith("data/demo_")}, key=natural)
        if not demos:
            others = "nor d3rlpy's (observations_0) nor robomimic's (data/demo_0); pass --mapping"
            raise BadInputError(f"{source}: neither D4RL's layout (observations, actions) {others}")
        demo = stored_datasets(file[f"data/{demos[0]}"])
        columns = {name: {"fields": [field]} for name, field in ROBOMIMIC.items() if field in demo}
        commands = [field for field in demo if field.startswith("obs/") and _COMMANDS.search(field)]
        for name, folder in ((STATE, "obs/"), (NEXT_STATE, "next_obs/")):
            rows = [field for field, d in demo.items() if field.startswith(folder) and d.ndim in (1, 2)]
            if found := sorted(field for field in rows if not _COMMANDS.search(field)):
                columns[name] = {"fields": found, "names": _labels(demo, found)}
        if STATE not in columns:
            advice = "run robomimic's dataset_states_to_obs.py, or map states by --mapping"
            has = f"has no obs of numbers, which are the state (its fields: {', '.join(demo)})"
            raise BadInputError(f"{source}: data/{demos[0]} {has}: {advice}")
        keys: dict[str, Any] = {"columns": columns, "episodes": "data/demo_*"}
        if commands:
            keys["remark"] = f"without {', '.join(commands)}, which would show a policy the command to find"
        with_success = [name for name in demos if "success" in file[f"data/{name}"].attrs]
        if len(with_success) == len(demos):
            columns[SUCCESS] = {"fields": ["@success"]}
        elif with_success:
            keys["remark"] = f"without the attribute success, which {len(with_success)} of {len(demos)} have"
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


def _episodes(file: Any, pattern: str | None, origin: str) -> Iterator[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Yield the name of each episode's part of the file, its fields, and its attributes as "@name"."""
    if pattern != NUMBERED:
        for group in _groups(file, pattern, origin):
            attributes = {f"@{name}": np.asarray(value) for name, value in group.attrs.items()}
            yield f"{origin}{group.name}".rstrip("/"), stored_datasets(group), attributes
        return
    numbered: dict[int, dict[str, Any]] = {}
    for name, dataset in stored_datasets(file).items():
        if found := re.fullmatch(r"(.+)_([0-9]+)", name):
            numbered.setdefault(int(found[2]), {})[found[1]] = dataset
    for number in sorted(numbered):
        yield f"{origin}/{number}", numbered[number], {}


def _groups(file: Any, pattern: str | None, origin: str) -> list[Any]:
    groups, h5py = [file], optional("h5py")
    if pattern is None:
        return groups
    for part in pattern.strip("/").split("/"):
        inside = [(g, name) for g in groups for name in sorted(g, key=natural) if fnmatchcase(name, part)]
        for group, name in inside:  # links may lead to another file
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                place = f"{origin}{group.name.rstrip('/')}/{name}"
                raise BadInputError(f"{place} is a link; replace it by a copy of its target")
        groups = [group[name] for group, name in inside if isinstance(group[name], h5py.Group)]
    if not groups:
        raise BadInputError(f"{origin}: no groups '{pattern}'; it has {', '.join(list(file)[:10])}")
    return groups
