"""Load the abstract simulator that a dataset is paired with: of a task, or from a file of the user's."""

import importlib.util
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.core.digest import file_digest
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ABSTRACT_STATE, Array, Column
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.protocols import AbstractSimulator
from astra_data.worlds.registry import TASKS, task_named


@dataclass(frozen=True)
class Pairing:
    """An abstract simulator, and the map φ to its states.

    Attributes:
        id: the simulator's name in the dataset.
        origin: the task that it belongs to, or the sha256 of its file.
        maze: that of the task; None where there is none.
        abstract_state: the column of abstract states, with names, units, frames and roles.
        abstraction: φ, target states (B, S) to abstract states (B, X), numpy in, numpy out.
        simulator: builds B simulators.
    """

    id: str
    origin: Mapping[str, str]
    maze: Maze | None
    abstract_state: Column
    abstraction: Callable[[Array], Array]
    simulator: Callable[[int], AbstractSimulator]


def pairing_named(name: str) -> Pairing:
    """Return the simulator of the task `name`, or the class `path.py:MySim` of a user's file.

    The class is an `Simulator` of `astra_data.worlds.protocols`.

    Raises:
        BadInputError: there is no such task, file or class, or the class lacks an attribute.
    """
    if ".py:" not in name:
        if name not in TASKS and name.endswith(".py"):
            raise BadInputError(f"{name}: expected the class after a colon, as in {name}:MySimulator")
        task = task_named(name)
        origin = {"task": task.name}
        maze = None if task.plane is None else task.maze
        return Pairing(task.simulator_id, origin, maze, task.abstract_state, task.abstraction, task.simulator)
    path, _, kind = name.rpartition(":")
    made = _load_class(Path(path), kind)
    needed = ("abstract_state", "abstraction", "parameters", "reset_to", "step")
    missing = [attribute for attribute in needed if not hasattr(made, attribute)]
    if missing:
        raise BadInputError(
            f"{name} has no {', '.join(missing)}: expected what astra_data.worlds.protocols asks of a "
            "Simulator"
        )
    column = made.abstract_state
    if not isinstance(column, Column):
        raise BadInputError(f"{name}.abstract_state is a {type(column).__name__}, expected a Column")
    origin = {"file_sha256": file_digest(Path(path))}
    return Pairing(kind, origin, None, replace(column, name=ABSTRACT_STATE), made.abstraction, made)


def _load_class(path: Path, kind: str) -> Any:  # noqa: ANN401 - any class
    if not path.is_file():
        raise BadInputError(f"{path} does not exist: expected a Python file with the simulator's class")
    spec = importlib.util.spec_from_file_location(f"simulator_of_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look it up there
    with explained(f"importing {path}"):
        spec.loader.exec_module(module)
    if not hasattr(module, kind):
        known = [key for key, value in vars(module).items() if isinstance(value, type)]
        raise BadInputError(f"{path} has no class '{kind}'; it has {', '.join(known) or 'none'}")
    return getattr(module, kind)


@contextmanager
def explained(what: str) -> Iterator[None]:
    """Turn an exception of the user's code into an error of one line that begins with `what`.

    Raises:
        BadInputError: for any exception.
    """
    try:
        yield
    except Exception as error:
        raise BadInputError(
            f"{what} fails with {type(error).__name__}: {error}; ASTRA_DATA_DEBUG=1 shows where"
        ) from error


def built(pairing: Pairing, count: int) -> AbstractSimulator:
    """Build `count` simulators.

    Raises:
        BadInputError: building them fails, or their states or parameters are of the wrong kind.
    """
    with explained(f"{pairing.id}({count})"):
        batch = pairing.simulator(count)
        parameters, shape = dict(batch.parameters), tuple(batch.state.shape)
    expected = (count, pairing.abstract_state.size)
    if shape != expected:
        raise BadInputError(f"{pairing.id}({count}).state has shape {shape}, expected {expected}")
    faults = [key for key, value in parameters.items() if not isinstance(value, int | float | str)]
    if faults:
        raise BadInputError(f"{pairing.id}.parameters: expected numbers or texts for {', '.join(faults)}")
    return batch


def checked_abstraction(pairing: Pairing, state: Array) -> Array:
    """Return φ(state), (B, X) float32, for `state` (B, S).

    Raises:
        BadInputError: φ fails on such states, or returns another shape.
    """
    expected = (len(state), pairing.abstract_state.size)
    with explained(f"the abstraction of {pairing.id}, given states {state.shape},"):
        abstract = np.ascontiguousarray(pairing.abstraction(state), dtype=np.float32)
    if abstract.shape != expected:
        raise BadInputError(
            f"the abstraction of {pairing.id} makes {abstract.shape} of states {state.shape}, "
            f"expected {expected}"
        )
    return abstract
