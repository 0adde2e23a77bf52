"""Pair: put the abstract simulator where the target was, give it the same action, keep where it lands."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from astra_data.columns import (
    ABSTRACT_NEXT_STATE,
    ABSTRACT_SIMULATED_NEXT_STATE,
    ABSTRACT_STATE,
    ACTION,
    NEXT_STATE,
    STATE,
    Array,
    Episode,
)
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import DatasetWriter
from astra_data.errors import BadInputError
from astra_data.progress import Progress
from astra_data.recipe import Config, NotNegative
from astra_data.results.provenance import machine
from astra_data.tasks import Task, task_named


class PairConfig(Config):
    """How strictly a reset of the simulator is checked."""

    reset_tolerance: NotNegative = 1e-6
    """Largest difference between φ(s) and what the simulator shows after being reset to it."""


def pair(task: str, config: PairConfig, *, dataset: Path, out: Path, progress: Progress) -> None:
    """Add the columns `abstract.*` to `dataset`, one vectorised reset and step per episode.

    Raises:
        BadInputError: the simulator does not show the state it was reset to.
        CorruptDatasetError: `dataset` is incomplete.
    """
    world = task_named(task)
    source = Dataset.open(dataset)
    began = time.perf_counter()
    description = {
        "name": source.description["name"],
        "stage": "pair",
        "config": config.model_dump(mode="json"),
        "parents": [source.identity],
        "seeds": source.description["seeds"],
        "environment": source.description["environment"],
        "simulator": {"id": "point_mass", **world.simulator(1).parameters},
    }
    meanings = {
        ABSTRACT_NEXT_STATE: "abstract state of the target after the action",
        ABSTRACT_SIMULATED_NEXT_STATE: "where the abstract simulator lands, reset to abstract.state",
    }
    added = [replace(world.abstract_state, name=name, meaning=text) for name, text in meanings.items()]
    steps = 0
    with DatasetWriter(
        out,
        [*source.schema, world.abstract_state, *added],
        fps=source.info["fps"],
        task=world.instruction,
        description=description,
        subset_seed=source.description["seeds"].get("subset", 0),
    ) as writer:
        for index, episode in enumerate(source.episodes()):
            paired = pair_steps(
                world,
                episode.columns[STATE],
                episode.columns[ACTION],
                episode.columns[NEXT_STATE],
                config.reset_tolerance,
            )
            writer.add(Episode(episode.uid, {**episode.columns, **paired}, episode.metadata))
            steps += len(episode)
            rate = steps / (time.perf_counter() - began)
            progress((index + 1) / len(source), f"{rate:,.0f} pairs/s")
        seconds = time.perf_counter() - began
        writer.made = {"wall_seconds": seconds, "pairs_per_second": steps / seconds, "machine": machine()}


def pair_steps(
    task: Task, state: Array, action: Array, next_state: Array, tolerance: float
) -> dict[str, Array]:
    """Return the `abstract.*` columns (T, X) for target steps `state` (T, S), `action` (T, A), (T, S)."""
    abstract = torch.from_numpy(np.ascontiguousarray(task.abstraction(state)))
    simulator = task.simulator(len(state))
    simulator.reset_to(abstract)
    difference = (simulator.state - abstract).abs()
    if float(difference.max()) > tolerance:
        step, entry = divmod(int(difference.argmax()), abstract.shape[1])
        name = (task.abstract_state.names or range(abstract.shape[1]))[entry]
        raise BadInputError(
            f"the simulator, reset to φ(s) of step {step}, shows {name} = "
            f"{float(simulator.state[step, entry]):.6g} and not {float(abstract[step, entry]):.6g} "
            f"(tolerance {tolerance:g}): check its reset_to and the task's abstraction"
        )
    landed = simulator.step(torch.from_numpy(np.ascontiguousarray(action)))
    return {
        ABSTRACT_STATE: abstract.numpy(),
        ABSTRACT_NEXT_STATE: np.ascontiguousarray(task.abstraction(next_state)),
        ABSTRACT_SIMULATED_NEXT_STATE: landed.numpy(),
    }
