"""Tasks and abstract simulators by name: of this package, of other installed ones, of files of the user's."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ABSTRACT_STATE, Array, Column
from astra_data.robots.ant.tasks import LONG, UMAZE
from astra_data.robots.humanoid.tasks import EXTENDED, KINEMATICS, WALKER2D
from astra_data.robots.nao.tasks import KICK, NAVIGATION
from astra_data.worlds.commands import Commands
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.protocols import AbstractSimulator
from astra_data.worlds.task import Task
from astra_data.worlds.user_code import expect, explained, file_of, is_user_code, offered, user_object

TASK_GROUP = "astra_data.tasks"  # the group of entry points under which installed packages offer tasks
SIMULATOR_GROUP = "astra_data.simulators"  # likewise, of abstract simulators
TASKS: dict[str, Task] = {task.name: task for task in (UMAZE, LONG, NAVIGATION, KICK, WALKER2D, KINEMATICS, EXTENDED)}
"""The tasks of the package."""


def known_names() -> tuple[str, ...]:
    """Return the names of the tasks of this package and of installed ones, without running these."""
    return (*TASKS, *(name for name in offered(TASK_GROUP) if name not in TASKS))


def task_named(name: str, besides: tuple[str, ...] = ()) -> Task:
    """Return the task of that name, or at "cart.py:TASK"; `besides` are names that an unknown one may have meant."""
    if name in TASKS:
        return TASKS[name]
    if place := name if is_user_code(name) else offered(TASK_GROUP).get(name):
        found = user_object(place)
        if not isinstance(found, Task):
            raise BadInputError(f"{name} is a {type(found).__name__}, expected a Task")
        return found
    known = (*known_names(), *besides)
    raise BadInputError(f"unknown task '{name}'{did_you_mean(name, known)}; name your own task like cart.py:TASK")


def place_of(name: str) -> str:
    """Return the place of the code of a task: of one that an installed package offers, where it is there."""
    return name if name in TASKS or is_user_code(name) else offered(TASK_GROUP).get(name, name)


@dataclass(frozen=True)
class Pairing:
    """An abstract simulator, and the map φ to its states; what a task tells is None or empty without one."""

    id: str  # the simulator's name in the dataset
    origin: Mapping[str, str]  # the task that it belongs to, the sha256 of its file, or its place in a package
    maze: Maze | None
    abstract_state: Column
    abstraction: Callable[[Array], Array]
    simulator: Callable[[int], AbstractSimulator]
    commands: Commands | None = None
    fps: int | None = None
    columns: tuple[Column, ...] = ()


def pairing_named(name: str) -> Pairing:
    """Return the simulator of a task, of an installed package, or a class at `path.py:MySim`; a task comes first."""
    if name not in TASKS and name.endswith(".py"):
        raise BadInputError(f"{name}: expected the class after a colon, as in {name}:MySimulator")
    installed = offered(SIMULATOR_GROUP)
    made: Any
    if is_user_code(name):
        made = user_object(name)
    elif name in installed and name not in known_names():
        made = user_object(installed[name])
    else:
        made = task_named(name, besides=tuple(installed))
    if isinstance(made, Task):
        return Pairing(
            id=made.simulator_id,
            origin={"task": made.name, **file_of(name)},
            maze=made.plane,
            abstract_state=made.abstract_state,
            abstraction=made.abstraction,
            simulator=made.own_simulator,
            commands=None if made.limits.are_normal else made.limits,
            fps=made.fps,
            columns=(made.state, made.action),
        )
    needed = ("abstract_state", "abstraction", "parameters", "reset_to", "step")
    if missing := [attribute for attribute in needed if not hasattr(made, attribute)]:
        expected = "expected what a Simulator has, see astra_data.worlds.protocols"
        raise BadInputError(f"{name} has no {', '.join(missing)}: {expected}")
    column = made.abstract_state
    if not isinstance(column, Column):
        raise BadInputError(f"{name}.abstract_state is a {type(column).__name__}, expected a Column")
    kind = name.rpartition(":")[2]
    column = replace(column, name=ABSTRACT_STATE)
    origin = file_of(name) if is_user_code(name) else {"package": offered(SIMULATOR_GROUP)[name]}
    return Pairing(kind, origin, None, column, made.abstraction, made)


def built(pairing: Pairing, count: int) -> AbstractSimulator:
    """Build `count` simulators; check their states and parameters."""
    with explained(f"{pairing.id}({count})"):
        batch = pairing.simulator(count)
        parameters, state = dict(batch.parameters), batch.state
    expect(f"{pairing.id}({count}).state", state, (count, pairing.abstract_state.size))
    if faults := [key for key, value in parameters.items() if not isinstance(value, int | float | str)]:
        raise BadInputError(f"{pairing.id}.parameters: expected numbers or texts for {', '.join(faults)}")
    return batch


def checked_abstraction(pairing: Pairing, state: Array) -> Array:
    """Return φ(state), (B, X) float32, for `state` (B, S); check its shape."""
    expected = (len(state), pairing.abstract_state.size)
    with explained(f"the abstraction of {pairing.id}, given states {state.shape},"):
        abstract = np.ascontiguousarray(pairing.abstraction(state), dtype=np.float32)
    if abstract.shape != expected:
        made = f"{abstract.shape} of states {state.shape}"
        raise BadInputError(f"the abstraction of {pairing.id} makes {made}, expected {expected}")
    return abstract
