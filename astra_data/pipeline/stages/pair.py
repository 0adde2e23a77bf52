"""Pair: reset the abstract simulator to φ(s), step it with the recorded action, and store its next state."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from astra_data.core.arrays import as_column, as_rows
from astra_data.core.config import Config, NotNegative
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import torch
from astra_data.core.progress import Progress, Stopwatch, silent
from astra_data.dataset import columns as keys
from astra_data.dataset.checkup import TURNS, full_turns
from astra_data.dataset.columns import Array, in_blocks
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import column_faults, names_apart, next_version, open_dataset
from astra_data.robots.registry import TASKS, Pairing, built, checked_abstraction, pairing_named
from astra_data.worlds.protocols import AbstractSimulator
from astra_data.worlds.user_code import expect_tensor, explained, stepped

BATCH = 4096  # simulators that are reset and stepped in one batch
_BLOCK = 8 * BATCH  # steps held in memory at once, rounded up to whole episodes
_MEANINGS = {
    keys.ABSTRACT_STATE: "abstract state of the target before the action",
    keys.ABSTRACT_NEXT_STATE: "abstract state of the target after the action",
    keys.ABSTRACT_SIMULATED_NEXT_STATE: "where the abstract simulator lands, reset to abstract.state",
}
_log = logging.getLogger(__name__)


class PairConfig(Config):
    """Tolerance of the check that the simulator was reset to φ(s)."""

    reset_tolerance: NotNegative = 1e-6
    """Maximum difference between φ(s) and the simulator's state after a reset to it."""


def pair(
    simulator: str,
    config: PairConfig = PairConfig(),
    *,
    dataset: str | Path,
    name: str | None = None,
    out: Path | None = None,
    progress: Progress = silent,
) -> Path:
    """Add the columns `abstract.*` to `dataset`, vectorized over its steps; return the new folder.

    Those that are left where another tool removed one of them are made anew.
    `simulator` is a task, for its abstract simulator, or `path.py:MySimulator`.

    Raises:
        BadInputError: the simulator is not in the state that it was reset to, or does not fit the dataset.

    Example:
        >>> from pathlib import Path
        >>> from astra_data import Dataset, pair
        >>> pairs = pair("antmaze-umaze", dataset="walks", out=Path("pairs_again"))
        >>> landed = "abstract.simulated_next_state"
        >>> Dataset.open(pairs).columns([landed])[landed].shape  # (N, X)
        (240, 4)
    """
    pairing = pairing_named(simulator)
    source = open_dataset(dataset)
    _check(source, pairing)
    stopwatch = Stopwatch()
    batch = built(pairing, BATCH)
    bounds = {} if pairing.commands is None else {"commands": {k: list(v) for k, v in pairing.commands.items()}}
    added = [replace(pairing.abstract_state, name=name, meaning=text) for name, text in _MEANINGS.items()]
    stays = [column for column in source.schema if column.name not in _MEANINGS]
    steps, reset_error, farthest = 0, 0.0, np.zeros(added[0].size)
    jumps = {unit: np.zeros(added[0].size, np.int64) for unit in TURNS}
    made, settings = {"id": pairing.id, **pairing.origin, **batch.parameters, **bounds}, config.model_dump(mode="json")
    with next_version(
        source, "columns", stage="pair", config=settings, name=name, out=out, schema=stays, more=added, simulator=made
    ) as writer:
        for episodes in in_blocks(source.episodes(), _BLOCK):
            read, tolerance = (keys.STATE, keys.ACTION, keys.NEXT_STATE), config.reset_tolerance
            columns = (as_rows(np.concatenate([one.columns[name] for one in episodes])) for name in read)
            paired, error = pair_steps(pairing, batch, *columns, tolerance=tolerance, first_step=steps)
            reset_error = max(reset_error, error)
            apart = paired[keys.ABSTRACT_NEXT_STATE] - paired[keys.ABSTRACT_SIMULATED_NEXT_STATE]
            for unit, turn in TURNS.items():
                jumps[unit] += (np.abs(apart) > turn / 2).sum(axis=0)
            farthest = np.maximum(farthest, np.abs(paired[keys.ABSTRACT_STATE]).max(axis=0))
            first = 0
            for episode in episodes:
                values = {name: as_column(array[first : first + len(episode)]) for name, array in paired.items()}
                writer.add(replace(episode, columns={**episode.columns, **values}))
                first += len(episode)
            steps += first
            rate = steps / stopwatch.seconds
            progress(steps / int(source.lengths.sum()), f"{rate:,.0f} pairs/s")
        writer.made = {"reset_error": reset_error, **stopwatch.spent()}
    turns = full_turns(pairing.abstract_state, farthest)
    for unit, half in (("rad", "π"), ("deg", "180°")):
        jumped = [entry for entry, rows in enumerate(jumps[unit]) if rows and turns[entry] == TURNS[unit]]
        if wrapped := [f"{_name(pairing, entry)} in {jumps[unit][entry]} of {steps} rows" for entry in jumped]:
            found = f"{', '.join(wrapped)}; a heading that wraps: make cos and sin of it in φ"
            _log.warning(f"{pairing.id} lands more than {half} from where the robot was: {found}")
    return writer.root


def pair_steps(
    pairing: Pairing,
    batch: AbstractSimulator,
    state: Array,
    action: Array,
    next_state: Array,
    *,
    tolerance: float,
    first_step: int = 0,
) -> tuple[dict[str, Array], float]:
    """Reset `batch`, of B simulators, to φ(s) of N target steps and step it with the actions, B at a time.

    Return the `abstract.*` columns (N, X), and the largest difference between φ(s) and the reset simulator.
    """
    abstract = checked_abstraction(pairing, state)
    landed = np.empty_like(abstract)
    size = len(batch.state)
    largest = 0.0
    for first in range(0, len(state), size):
        rows = np.arange(first, first + size).clip(max=len(state) - 1)
        wanted = torch.from_numpy(abstract[rows])
        with explained(f"reset_to of {pairing.id}"):
            batch.reset_to(wanted)
            shown = batch.state
        difference = (expect_tensor(f"after reset_to, {pairing.id}.state", shown) - wanted).abs()
        if not float(difference.max()) <= tolerance:
            row, entry = divmod(int(difference.argmax()), wanted.shape[1])
            raise BadInputError(
                f"the simulator, reset to φ(s) of step {first_step + rows[row]}, has {_name(pairing, entry)} = "
                f"{float(shown[row, entry]):.6g}, expected {float(wanted[row, entry]):.6g} "
                f"(tolerance {tolerance:g}): check its reset_to and the abstraction"
            )
        largest = max(largest, float(difference.max()))
        reached = stepped(batch, torch.from_numpy(as_rows(action[rows])), f"step of {pairing.id}").numpy()
        if reached.shape != wanted.shape:
            raise BadInputError(f"step of {pairing.id} returns shape {reached.shape}, expected {tuple(wanted.shape)}")
        if not np.isfinite(reached).all():
            row, entry = np.argwhere(~np.isfinite(reached))[0]
            where = f"stepped from φ(s) of step {first_step + rows[row]}"
            got = f"{_name(pairing, entry)} = {reached[row, entry]}"
            raise BadInputError(f"the simulator, {where}, gives {got}: expected finite states from its step")
        landed[first : first + size] = reached[: len(state) - first]
    columns = {
        keys.ABSTRACT_STATE: abstract,
        keys.ABSTRACT_NEXT_STATE: checked_abstraction(pairing, next_state),
        keys.ABSTRACT_SIMULATED_NEXT_STATE: landed,
    }
    return columns, largest


def _name(pairing: Pairing, entry: int) -> str:
    names = pairing.abstract_state.names
    return names[entry] if names else f"value {entry}"


def _check(source: Dataset, pairing: Pairing) -> None:
    task = source.description["environment"].get("id")
    known = TASKS.get(task)
    if pairing.maze is not None and known and known.plane not in (None, pairing.maze):
        fault = f"was collected for {task}, which has another maze than {pairing.origin['task']}"
        raise BadInputError(f"{source.reference} {fault}: give --simulator {task}")
    faults = [f"no column {name}" for name in (keys.STATE, keys.ACTION, keys.NEXT_STATE) if name not in source.features]
    if _MEANINGS.keys() <= source.features.keys():
        faults.append(f"{keys.ABSTRACT_STATE} already: it is paired")
    if pairing.fps not in (None, source.info["fps"]):
        faults.append(f"{source.info['fps']} steps per second, where {pairing.id} makes {pairing.fps}")
    if faults:
        raise BadInputError(f"{source.root} has {' and '.join(faults)}; expected a dataset to be paired")
    expected = pairing.origin.get("task", "")
    if faults := [fault for column in pairing.columns for fault in column_faults(source, column, expected)]:
        raise BadInputError(f"{source.reference} {'; '.join(faults)}")
    if warning := names_apart(source, pairing.columns, expected):
        _log.warning(warning)
