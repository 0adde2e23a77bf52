"""Minari: a folder that `minari.load_dataset` reads once it lies in $MINARI_DATASETS_PATH."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.core.optional import optional
from astra_data.dataset.atomic import atomic_folder
from astra_data.dataset.columns import (
    ACTION,
    GOAL,
    NEXT_STATE,
    REWARD,
    STATE,
    TERMINATED,
    TRUNCATED,
    Array,
    Episode,
)
from astra_data.dataset.reader import Dataset

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer


def export(dataset: Dataset, out: Path) -> None:
    """Write observations (T + 1, S), actions (T, A), rewards, terminations and truncations (T,) per episode.

    With goals, observations are a dict of "observation" and "desired_goal" (T + 1, G). The id is the path of
    `out` in Minari's folder, or its name if it lies elsewhere.

    Raises:
        BadInputError: next states are not the states of the following steps, as Minari assumes, or the name
            of `out` is not a valid id.
    """
    minari = optional("minari", "minari")
    from gymnasium.spaces import Box, Dict  # noqa: PLC0415 - only needed here
    from minari.dataset.minari_dataset import parse_dataset_id  # noqa: PLC0415
    from minari.dataset.minari_storage import MinariStorage  # noqa: PLC0415
    from minari.storage.datasets_root_dir import get_dataset_path  # noqa: PLC0415

    shelf, place = get_dataset_path().resolve(), out.resolve()
    name = str(place.relative_to(shelf)) if place.is_relative_to(shelf) else place.name
    # Its parser raises a TypeError for a name without a version.
    try:
        parse_dataset_id(name)
    except (ValueError, TypeError) as error:
        raise BadInputError(
            f"{out}: '{name}' is not a Minari id; end --out with a name and a version, such as maze/random-v0"
        ) from error

    def box(column: str) -> Box:
        shape = tuple(dataset.features[column]["shape"])
        return Box(-np.inf, np.inf, shape, np.float32)

    goal = {"desired_goal": box(GOAL)} if GOAL in dataset.features else {}
    observed = Dict({"observation": box(STATE), **goal}) if goal else box(STATE)
    # Minari does not handle relative paths.
    with atomic_folder(place) as folder:
        storage = MinariStorage.new(folder / "data", observed, box(ACTION), data_format="hdf5")
        description = f"{dataset.reference}, content hash {dataset.content_hash}"
        about = {"dataset_id": name, "minari_version": minari.__version__, "description": description}
        storage.update_metadata(about)
        storage.update_episodes(_buffers(dataset))


def _buffers(dataset: Dataset) -> "Iterator[EpisodeBuffer]":
    from minari.data_collector import EpisodeBuffer  # noqa: PLC0415 - an extra

    goal = {GOAL: "desired_goal"} if GOAL in dataset.features else {}
    columns = [STATE, *goal, ACTION, REWARD, TERMINATED, TRUNCATED, NEXT_STATE]
    for number, episode in enumerate(dataset.episodes(columns)):
        values = episode.columns
        states = _with_last(episode, values[NEXT_STATE][-1:])
        goals = {key: np.concatenate([values[GOAL], values[GOAL][-1:]]) for key in goal.values()}
        seed = episode.metadata.get("seed")
        yield EpisodeBuffer(
            id=number,
            seed=seed if isinstance(seed, int) else None,
            observations={"observation": states, **goals} if goal else states,
            actions=values[ACTION].reshape(len(episode), -1),
            rewards=values[REWARD],
            terminations=values[TERMINATED],
            truncations=values[TRUNCATED],
        )


def _with_last(episode: Episode, last: Array) -> Array:
    states = episode.columns[STATE]
    if not np.array_equal(episode.columns[NEXT_STATE][:-1], states[1:]):
        raise BadInputError(
            f"episode {episode.uid}: a next state is not the state of the next step, which Minari cannot "
            "store; d4rl and robomimic can"
        )
    return np.concatenate([states, last])
