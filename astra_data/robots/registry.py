"""The tasks by name: those of the package, of other installed packages, and of files of the user's.

A task of a file or of a package is code, which is run when the task is named.
"""

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.robots.ant.tasks import ANTMAZE_TASKS
from astra_data.robots.humanoid.tasks import HUMANOID_TASKS
from astra_data.robots.nao.tasks import NAO_TASKS
from astra_data.worlds.own_code import is_own_code, offered, own_object
from astra_data.worlds.task import Task

TASKS: dict[str, Task] = {task.name: task for task in (*ANTMAZE_TASKS, *NAO_TASKS, *HUMANOID_TASKS)}
"""The tasks of the package."""

ENTRY_POINTS = "astra_data.tasks"
"""The group of entry points under which installed packages offer tasks."""


def known_names() -> tuple[str, ...]:
    """Return the names of the tasks of this package and of installed ones, without running these."""
    return (*TASKS, *(name for name in offered(ENTRY_POINTS) if name not in TASKS))


def task_named(name: str, besides: tuple[str, ...] = ()) -> Task:
    """Return a task of this or an installed package, or that of "cart.py:TASK" or "package.module:TASK".

    `besides` are other names that an unknown one may have meant.

    Raises:
        BadInputError: there is no such task, file or module, or it is no task.
    """
    if name in TASKS:
        return TASKS[name]
    if is_own_code(name):
        return _a_task(name, own_object(name))
    installed = offered(ENTRY_POINTS)
    if name in installed:
        return _a_task(name, own_object(installed[name]))
    known = (*known_names(), *besides)
    raise BadInputError(
        f"unknown task '{name}'{did_you_mean(name, known)}; name your own task like cart.py:TASK"
    )


def place_of(name: str) -> str:
    """Return the place of the code of a task: of one that an installed package offers, where it is there."""
    return name if name in TASKS or is_own_code(name) else offered(ENTRY_POINTS).get(name, name)


def known_tasks() -> dict[str, Task]:
    """Return the tasks of this package and of installed ones, by name.

    Raises:
        BadInputError: a package offers something else, or it fails.
    """
    return {name: task_named(name) for name in known_names()}


def _a_task(name: str, found: object) -> Task:
    if not isinstance(found, Task):
        raise BadInputError(f"{name} is a {type(found).__name__}, expected a Task")
    return found
