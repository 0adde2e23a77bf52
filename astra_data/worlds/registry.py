"""The tasks by name."""

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.worlds.ant.tasks import ANTMAZE_TASKS
from astra_data.worlds.humanoid.tasks import HUMANOID_TASKS
from astra_data.worlds.nao.tasks import NAO_TASKS
from astra_data.worlds.task import Task

TASKS: dict[str, Task] = {task.name: task for task in (*ANTMAZE_TASKS, *NAO_TASKS, *HUMANOID_TASKS)}


def task_named(name: str) -> Task:
    """Return a task.

    Raises:
        BadInputError: there is no such task.
    """
    if name not in TASKS:
        raise BadInputError(f"unknown task '{name}'{did_you_mean(name, TASKS)}")
    return TASKS[name]
