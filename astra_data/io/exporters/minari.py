"""Minari: a folder that `minari.load_dataset` reads once it lies in $MINARI_DATASETS_PATH."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.core.optional import optional
from astra_data.dataset.columns import (
    ACTION,
    GOAL,
    NEXT_STATE,
    REWARD,
    STATE,
    Array,
    Episode,
)
from astra_data.dataset.reader import Dataset
from astra_data.io.export_record import Export
from astra_data.io.hdf5_file import hdf5_file
from astra_data.io.layouts import MINARI, as_stored, fields_of


def write(dataset: Dataset, path: Path, out: Path) -> None:
    """Write observations (T + 1, S), actions (T, A), rewards, terminations and truncations (T,) per episode.

    With goals, observations are a dict of "observation" and "desired_goal" (T + 1, G). Other columns become
    infos/<name> (T, ...), the episodes' uids and metadata their attributes "astra_data/...". The files are
    those that Minari's own storage makes, which does not notice a full disk.

    Args:
        dataset: any whose next states are the states of the following steps.
        path: the new folder.
        out: where it will lie, whose end is the id: its path in Minari's folder, or its name elsewhere.

    Raises:
        BadInputError: a next state is not the state of the following step, as Minari assumes, or the name of
            `out` is not a valid id.
    """
    minari = optional("minari")
    from gymnasium.spaces import Box, Dict  # noqa: PLC0415 - only needed here
    from minari.serialization import serialize_space  # noqa: PLC0415 - an extra

    identity = _dataset_id(out)

    def box(column: str) -> Box:
        shape = tuple(dataset.features[column]["shape"])
        return Box(-np.inf, np.inf, shape, np.float32)

    names = [column.name for column in dataset.schema]
    has_goal = GOAL in names
    observations = "observations/observation" if has_goal else "observations"
    own = {
        **MINARI,
        STATE: observations,
        NEXT_STATE: f"next_{observations}",
        GOAL: "observations/desired_goal",
    }
    fields = fields_of(names, own)
    exported = Export(dataset, fields)
    data = path / "data"
    data.mkdir()
    with hdf5_file(data / "main_data.hdf5", track_order=True) as (file, disk):
        for number, episode in enumerate(disk.until_it_fails(exported.episodes())):
            group = file.create_group(f"episode_{number}")
            group.attrs.update(_attributes(number, episode))
            values = {name: as_stored(name, column) for name, column in episode.columns.items()}
            arrays = {fields[name]: values[name] for name in names if name != NEXT_STATE}
            arrays[fields[STATE]] = _with_last(episode.uid, values[STATE], values[NEXT_STATE])
            if REWARD not in fields:
                arrays[MINARI[REWARD]] = np.zeros(len(episode), np.float32)
            if has_goal:
                arrays[fields[GOAL]] = np.concatenate([values[GOAL], values[GOAL][-1:]])
            for field, array in arrays.items():
                group.create_dataset(field, data=array, chunks=True, maxshape=(None, *array.shape[1:]))
    goal = {"desired_goal": box(GOAL)} if has_goal else {}
    metadata: Mapping[str, Any] = {
        "total_episodes": len(dataset),
        "total_steps": int(dataset.lengths.sum()),
        "data_format": "hdf5",
        "jpeg_encoding": True,
        "observation_space": serialize_space(
            Dict({"observation": box(STATE), **goal}) if goal else box(STATE)
        ),
        "action_space": serialize_space(box(ACTION)),
        "dataset_id": identity,
        "minari_version": minari.__version__,
        "description": f"{dataset.reference}, content hash {dataset.content_hash}",
        "dataset_size": round((data / "main_data.hdf5").stat().st_size / 1e6, 1),
        "astra_data": exported.record(),
    }
    (data / "metadata.json").write_text(json.dumps(metadata, ensure_ascii=False), encoding="utf-8")


def _dataset_id(out: Path) -> str:
    """Return the id of a dataset in folder `out`: its path in Minari's folder, or its name elsewhere."""
    from minari.dataset.minari_dataset import parse_dataset_id  # noqa: PLC0415 - an extra
    from minari.storage.datasets_root_dir import get_dataset_path  # noqa: PLC0415 - an extra

    shelf, place = get_dataset_path().resolve(), out.resolve()
    name = str(place.relative_to(shelf)) if place.is_relative_to(shelf) else place.name
    # Its parser raises a TypeError for a name without a version.
    try:
        parse_dataset_id(name)
    except (ValueError, TypeError) as error:
        raise BadInputError(
            f"{out}: '{name}' is not a Minari id; end --out with a name and a version, such as maze/random-v0"
        ) from error
    return name


def _attributes(number: int, episode: Episode) -> dict[str, Any]:
    seed = episode.metadata.get("seed")
    facts = {f"astra_data/{key}": fact for key, fact in episode.metadata.items()}
    known = {"id": number, "total_steps": len(episode), "astra_data/episode_uid": episode.uid, **facts}
    return known | ({"seed": seed} if isinstance(seed, int) else {})


def _with_last(uid: int, states: Array, next_states: Array) -> Array:
    if not np.array_equal(next_states[:-1], states[1:]):
        raise BadInputError(
            f"episode {uid}: a next state is not the state of the next step, which Minari cannot "
            "store; d4rl and robomimic can"
        )
    return np.concatenate([states, next_states[-1:]])
