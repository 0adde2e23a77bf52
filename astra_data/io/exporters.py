"""Export of datasets to the formats of other libraries, whole or not at all."""

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.arrays import Bools, as_rows
from astra_data.core.config import did_you_mean
from astra_data.core.durable import hidden_folder, publish, refuse_existing
from astra_data.core.errors import BadInputError, optional
from astra_data.dataset.columns import ACTION, GOAL, NEXT_STATE, REWARD, STATE, TERMINATED, TRUNCATED, Array, Episode
from astra_data.dataset.reader import Dataset
from astra_data.io.hdf5_file import D3RLPY, D4RL, MINARI, ROBOMIMIC

NEEDED = (STATE, ACTION, TERMINATED, TRUNCATED, NEXT_STATE)  # columns that every format needs
VECTORS = (STATE, NEXT_STATE, GOAL, ACTION)  # (T, size) in every format, also with one value per step
VALID_SHARE = 0.1  # of the recordings, in robomimic's mask/valid, as in its own split; the others are in mask/train

_log = logging.getLogger(__name__)


def export(dataset: Dataset, out: Path, *, format: str) -> None:
    """Write `dataset` to a new `out`, in the layout of the library `format`; rewards are 0 where it has none."""
    if format not in EXPORTERS:
        raise BadInputError(f"format '{format}': unknown{did_you_mean(format, [*EXPORTERS, 'card'])}")
    if missing := [name for name in NEEDED if name not in dataset.features]:
        raise BadInputError(f"{dataset.reference} cannot be exported: it lacks {', '.join(missing)}")
    if REWARD not in dataset.features:
        _log.warning("%s has no %s: rewards are written as 0", dataset.reference, REWARD)
    if dataset.cameras:
        _log.warning("%s: %s left out, pictures are not exported", dataset.reference, ", ".join(dataset.cameras))
    refuse_existing(out)
    with hidden_folder(out) as folder:
        path = folder if format == "minari" else folder / out.name
        EXPORTERS[format](dataset, path, out)
        publish(path, out)


def _d4rl(dataset: Dataset, path: Path, out: Path) -> None:
    """Write flat arrays (N, ...); every episode ends in a terminal or a timeout: nothing else parts them."""
    fields = _fields(dataset, {name: field for name, field in D4RL.items() if name != TRUNCATED})
    columns = [values for *_, values in _episodes(dataset)]
    ends = np.cumsum(dataset.lengths) - 1
    with hdf5_file(path) as file:
        for name in (*(column.name for column in dataset.schema), *({REWARD} - dataset.features.keys())):
            file[fields[name]] = np.concatenate([values[name] for values in columns])
        timeouts = np.concatenate([values[TRUNCATED] for values in columns])
        timeouts[ends] = True
        file[D4RL[TRUNCATED]] = timeouts & ~np.concatenate([values[TERMINATED] for values in columns])


def _d3rlpy(dataset: Dataset, path: Path, out: Path) -> None:
    """Write what d3rlpy's `ReplayBuffer.load` reads, version 2.1 of its layout; goals follow states in observations."""
    fields = _fields(dataset, D3RLPY | {TERMINATED: "infos/next.terminated"})
    with hdf5_file(path) as file:
        file["columns"] = list(D3RLPY.values())
        file["num_episodes"] = len(dataset)
        file["version"] = "2.1"
        for number, _, values in _episodes(dataset):
            file[f"terminated_{number}"] = bool(values[TERMINATED][-1])
            goal = [values.pop(GOAL)] if GOAL in values else []
            values[STATE] = np.concatenate([values[STATE], *goal], axis=1)
            values[REWARD] = as_rows(values[REWARD])
            for name, array in values.items():
                file[f"{fields[name]}_{number}"] = array


def _robomimic(dataset: Dataset, path: Path, out: Path) -> None:
    """Write data/demo_i: actions (T, A), rewards, dones, truncated (T,), obs/state, next_obs/state (T, S).

    `dones` is terminated alone: robomimic's learners do not bootstrap on it. mask/train and mask/valid follow the
    permutation of the nested subsets, by recordings with all copies of them, or what an augmentation held out.
    """
    observed = {STATE: "obs/state", NEXT_STATE: "next_obs/state", GOAL: "obs/goal"}
    fields = _fields(dataset, ROBOMIMIC | observed)
    environment = dataset.description["environment"]
    made_by = {key: value for key, value in environment.items() if key != "id"}
    name = environment.get("id", dataset.description["name"])
    arguments = {"env_name": name, "type": 2, "env_kwargs": made_by}  # 2 is gym
    with hdf5_file(path) as file:
        data = file.create_group("data")
        data.attrs["total"] = int(dataset.lengths.sum())
        data.attrs["env_args"] = json.dumps(arguments)
        for number, episode, values in _episodes(dataset):
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = len(episode)
            demo.attrs["episode_uid"] = episode.uid
            for name in (TERMINATED, TRUNCATED):
                values[name] = values[name].astype("int64")
            for name, array in values.items():
                demo[fields[name]] = array
            if GOAL in values:
                demo["next_obs/goal"] = values[GOAL]
        is_valid = _validation(dataset)
        for key, part in (("train", ~is_valid), ("valid", is_valid)):
            if part.any():
                file[f"mask/{key}"] = [f"demo_{episode}".encode() for episode in np.flatnonzero(part)]


def _validation(dataset: Dataset) -> Bools:
    """Return which episodes (E,) are for validation; copies go where their recording goes."""
    recordings = dataset.recordings
    if dataset.held_out.any():
        return np.isin(recordings, recordings[dataset.held_out])
    ordered = list(dict.fromkeys(recordings[dataset.order].tolist()))
    train = len(ordered) - int(len(ordered) * VALID_SHARE)
    return np.isin(recordings, ordered[train:])


def _minari(dataset: Dataset, path: Path, out: Path) -> None:
    """Write observations (T + 1, S), a dict where there are goals, actions (T, A), rewards and ends (T,) per episode.

    `minari.create_dataset_from_buffers` would write into Minari's folder alone, and not notice a full disk.
    """
    minari = optional("minari")
    from gymnasium.spaces import Box, Dict  # noqa: PLC0415 - only needed here
    from minari.dataset.minari_dataset import parse_dataset_id  # noqa: PLC0415 - an extra
    from minari.dataset.minari_storage import MinariStorage  # noqa: PLC0415 - an extra
    from minari.storage.datasets_root_dir import get_dataset_path  # noqa: PLC0415 - an extra

    shelf, place = get_dataset_path().resolve(), out.resolve()
    identity = str(place.relative_to(shelf)) if place.is_relative_to(shelf) else place.name
    try:  # its parser raises a TypeError for a name without a version
        parse_dataset_id(identity)
    except (ValueError, TypeError) as error:
        advice = "end --out with a name and a version, such as maze/random-v0"
        raise BadInputError(f"{out}: '{identity}' is not a Minari id; {advice}") from error
    known = dataset.features
    boxes = {n: Box(-np.inf, np.inf, known[n]["shape"], np.float32) for n in (STATE, ACTION, GOAL) if n in known}
    seen: Box | Dict = boxes[STATE]
    observed = {STATE: "observations"}
    if GOAL in boxes:
        seen = Dict({"observation": boxes[STATE], "desired_goal": boxes[GOAL]})
        observed = {STATE: "observations/observation", GOAL: "observations/desired_goal"}
    fields = _fields(dataset, MINARI | observed)
    storage = MinariStorage.new(path.absolute() / "data", seen, boxes[ACTION])
    with hdf5_file(path / "data/main_data.hdf5", track_order=True) as file:
        for number, episode, values in _episodes(dataset):
            group = file.create_group(f"episode_{number}")
            group.attrs.update({"id": number, "total_steps": len(episode)})
            if isinstance(seed := episode.metadata.get("seed"), int):
                group.attrs["seed"] = seed
            following = values.pop(NEXT_STATE)
            if not np.array_equal(following[:-1], values[STATE][1:]):
                odd = f"episode {episode.uid}: a next state is not the state of the next step"
                raise BadInputError(f"{odd}, which Minari cannot store; d4rl and robomimic can")
            values[STATE] = np.concatenate([values[STATE], following[-1:]])
            if GOAL in values:
                values[GOAL] = np.concatenate([values[GOAL], values[GOAL][-1:]])
            for name, array in values.items():
                group.create_dataset(fields[name], data=array, chunks=True, maxshape=(None, *array.shape[1:]))
    storage.update_metadata(
        {
            "total_episodes": len(dataset),
            "total_steps": int(dataset.lengths.sum()),
            "dataset_id": identity,
            "minari_version": minari.__version__,
            "description": f"{dataset.reference}, content hash {dataset.content_hash}",
            "dataset_size": float(storage.get_size()),
        }
    )


Exporter = Callable[[Dataset, Path, Path], None]  # writes a dataset to a new path, which is renamed to `out` afterwards
EXPORTERS: dict[str, Exporter] = {"d3rlpy": _d3rlpy, "d4rl": _d4rl, "minari": _minari, "robomimic": _robomimic}


def _fields(dataset: Dataset, standard: dict[str, str]) -> dict[str, str]:
    """Return the field of each column: a standard one of the format, or another one, among its infos."""
    fields = {REWARD: standard[REWARD]}
    for name in (column.name for column in dataset.schema):
        info = f"infos/{name}"
        fields[name] = standard.get(name, f"{info}_" if info in standard.values() else info)
    return fields


def _episodes(dataset: Dataset) -> Iterator[tuple[int, Episode, dict[str, Array]]]:
    """Yield each episode with its number and its columns, (T,) or (T, size)."""
    for number, episode in enumerate(dataset.episodes([column.name for column in dataset.schema])):
        values = {name: as_rows(v) if name in VECTORS else v for name, v in episode.columns.items()}
        yield number, episode, {REWARD: np.zeros(len(episode), np.float32)} | values


@contextmanager
def hdf5_file(path: Path, *, track_order: bool = False) -> Iterator[Any]:
    """Yield a new HDF5 file, written to `path` once it is whole: HDF5 itself crashes where a disk fails."""
    # In memory by HDF5's own driver: one for Python's files may crash once the collector frees them.
    with optional("h5py").File(path, "w", driver="core", backing_store=False, track_order=track_order) as file:
        yield file
        file.flush()
        content = file.id.get_file_image()
    path.write_bytes(content)
