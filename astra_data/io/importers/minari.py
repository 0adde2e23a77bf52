"""Minari: a dataset's folder, read by Minari itself, one episode at a time.

Fields are `observations`, `next_observations`, `actions`, `rewards`, `terminations`, `truncations` and
`infos`; where a space is a dictionary or a tuple, its parts: `observations/desired_goal`, `actions/0`. Where
the info of the reset was recorded, `infos` are those before a step in columns of observations and those after
it in all others, and `next_infos` those after it in any.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from astra_data.core.errors import BadInputError, optional
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, STATE, Array
from astra_data.io.hdf5_file import MINARI, check_storage, refuse_links, stored_datasets, unpacked_bytes
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import Block, Source, row_count

GOAL_FIELD = "observations/desired_goal"


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield each episode as one block."""
    for episode in _open(source).iterate_episodes():
        origin = f"{source}/episode_{episode.id}"
        with source.tolerant():
            fields = _fields(episode)
            notes = _after_steps(fields, mapping, origin)
            shapes = {name: values.shape for name, values in fields.items()}
            if row_count(origin, mapping.all_fields, shapes):
                used = {field: fields[field] for field in mapping.all_fields}
                known = [name for name in fields if not {name, f"next_{name}"} & used.keys()]
                known = [name for name in known if not name.startswith("next_")]
                yield Block(used, origin, starts=True, notes=notes, known=known)


def layout(source: Source) -> dict[str, Any]:
    """Return the keys of a mapping: the state is every part of the observation but the desired goal and pictures."""
    fields = _fields(next(iter(_open(source).iterate_episodes([0]))))
    pictures = {name for name, values in fields.items() if values.ndim > 2 and values.dtype == np.uint8}
    state = [f for f in fields if f.split("/")[0] == "observations" and f not in {GOAL_FIELD, *pictures}]
    if not state:
        raise BadInputError(f"{source}: expected observations that are no pictures, got {', '.join(sorted(pictures))}")
    columns = {STATE: {"fields": state}, NEXT_STATE: {"fields": [f"next_{field}" for field in state]}}
    columns |= {name: {"fields": [field]} for name, field in MINARI.items()}
    columns[ACTION]["fields"] = [field for field in fields if field.split("/")[0] == "actions"]
    return {"columns": columns | ({GOAL: {"fields": [GOAL_FIELD]}} if GOAL_FIELD in fields else {})}


def _open(source: Source) -> Any:
    """Open the dataset; Minari itself reads whole episodes, and follows links into other files."""
    minari = optional("minari")
    for path in (source.path / "data").rglob("*.hdf5"):
        if not path.is_file():
            raise BadInputError(f"{path} is a device or a pipe, expected a file")
        with optional("h5py").File(path, "r") as file:
            refuse_links(file, str(source))
            datasets = stored_datasets(file)
            check_storage(datasets, str(source))
            source.refuse_beyond(unpacked_bytes(datasets))
    return minari.MinariDataset(source.path / "data")


def _fields(episode: Any) -> dict[str, Array]:
    observations = dict(_parts("observations", episode.observations))
    infos = dict(_parts("infos", episode.infos or {}))  # None where none were recorded
    with_reset = {name: values for name, values in infos.items() if len(values) == len(episode.rewards) + 1}
    between = observations | with_reset
    steps = infos | {name: values[:-1] for name, values in between.items()}
    steps |= {f"next_{name}": values[1:] for name, values in between.items()}
    steps |= dict(_parts("actions", episode.actions))
    for name in ("rewards", "terminations", "truncations"):
        steps[name] = np.asarray(getattr(episode, name))
    return steps


def _after_steps(fields: dict[str, Array], mapping: ImportMapping, origin: str) -> tuple[str, ...]:
    """Let infos with an entry of the reset be those after each step, but for observations; return a note."""
    observed, others = set[str](), set(mapping.split.ends)
    for name, column in mapping.columns.items():
        (observed if name.startswith("observation") else others).update(column.fields)
    with_reset = sorted(name for name in fields if name.startswith("infos/") and f"next_{name}" in fields)
    if both := [name for name in with_reset if name in observed & others]:
        fault = f"{', '.join(both)} has an entry for the reset, too, and is taken as an observation, before a step"
        advice = f"write next_{both[0]} for what is after the step"
        raise BadInputError(f"{origin}: {fault}, and of its outcome: {advice}")
    after = [name for name in with_reset if name in others]
    for name in after:
        fields[name] = fields[f"next_{name}"]
    return (f"{', '.join(after)}: of one entry more than steps, each step has the one after it",) if after else ()


def _parts(name: str, value: Any) -> Iterator[tuple[str, Array]]:
    if isinstance(value, dict | tuple):
        pairs = sorted(value.items()) if isinstance(value, dict) else enumerate(value)
        for key, part in pairs:
            yield from _parts(f"{name}/{key}", part)
    else:
        yield name, np.asarray(value)
