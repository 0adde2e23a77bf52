"""What pairing needs of an abstract simulator: those of the tasks, and your own."""

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from astra_data.columns import ABSTRACT_STATE, Array, Column
from astra_data.errors import BadInputError
from astra_data.simulator import AbstractSimulator
from astra_data.tasks import TASKS, task_named


@dataclass(frozen=True)
class Pairing:
    """An abstract simulator, and the map φ to its states.

    Attributes:
        id: names the simulator in the dataset.
        abstract_state: the column of abstract states, with names, units, frames and roles.
        abstraction: φ, target states (B, S) to abstract states (B, X), numpy in, numpy out.
        simulator: builds B simulators.
    """

    id: str
    abstract_state: Column
    abstraction: Callable[[Array], Array]
    simulator: Callable[[int], AbstractSimulator]


def pairing_named(name: str) -> Pairing:
    """Return the simulator of the task `name`, or the class `path.py:MySim` of a file of yours.

    Your class is built as `MySim(num_envs)`, is an `AbstractSimulator`, and has two attributes more:
    `abstract_state`, a `Column`, and `abstraction`, a static method.

    Raises:
        BadInputError: there is no such task, file or class, or the class lacks something.
    """
    if ".py:" not in name:
        if name not in TASKS and name.endswith(".py"):
            raise BadInputError(f"{name}: expected the class after a colon, as in {name}:MySimulator")
        task = task_named(name)
        return Pairing(task.simulator_id, task.abstract_state, task.abstraction, task.simulator)
    path, _, kind = name.rpartition(":")
    made = _load_class(Path(path), kind)
    needed = ("abstract_state", "abstraction", "parameters", "reset_to", "step")
    missing = [attribute for attribute in needed if not hasattr(made, attribute)]
    if missing:
        raise BadInputError(f"{name} has no {', '.join(missing)}; see astra_data.simulator and .pairing")
    column = made.abstract_state
    if not isinstance(column, Column):
        raise BadInputError(f"{name}.abstract_state is a {type(column).__name__}, expected a Column")
    return Pairing(kind, replace(column, name=ABSTRACT_STATE), made.abstraction, made)


def _load_class(path: Path, kind: str) -> Any:  # noqa: ANN401 - any class
    if not path.is_file():
        raise BadInputError(f"{path} does not exist: expected a Python file with the simulator's class")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with explained(f"{path}, imported,"):
        spec.loader.exec_module(module)
    if not hasattr(module, kind):
        known = [key for key, value in vars(module).items() if isinstance(value, type)]
        raise BadInputError(f"{path} has no class '{kind}'; it has {', '.join(known) or 'none'}")
    return getattr(module, kind)


@contextmanager
def explained(what: str) -> Iterator[None]:
    """Turn an exception of a user's code into one line that begins with `what`.

    Raises:
        BadInputError: for any exception.
    """
    try:
        yield
    except Exception as error:
        raise BadInputError(
            f"{what} fails with {type(error).__name__}: {error}; ASTRA_DATA_DEBUG=1 shows where"
        ) from error


def checked_abstraction(pairing: Pairing, state: Array) -> Array:
    """Return φ(state), (B, X) float32, for `state` (B, S).

    Raises:
        BadInputError: φ does not take such states, or does not give abstract states.
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
