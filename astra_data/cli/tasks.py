"""`astra-data tasks` and `astra-data label`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from astra_data.cli.arguments import DatasetName, NewName, Out, show_table, task_at
from astra_data.core.naming import first_few

if TYPE_CHECKING:
    from astra_data.worlds.task import Task

_SHOWN = 4
"""Names that a row lists."""


def tasks(
    task: Annotated[
        str | None,
        typer.Argument(
            metavar="TASK",
            help="Test this task and list its errors: a name, or a place such as cart.py:TASK.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """List the named tasks and their parts; or test one task."""
    if task is not None:
        task_at(task)
    from rich.table import Table

    from astra_data.core.errors import BadInputError
    from astra_data.robots.registry import TASKS, known_tasks, task_named

    if task is not None:
        from astra_data.worlds.walk_through import check_task

        named = task_named(task)
        if faults := check_task(named):
            raise BadInputError("\n".join(f"task {task}: {fault}" for fault in faults))
        bounds = ", ".join(f"{axis} {low:g}…{high:g}" for axis, (low, high) in named.limits.items())
        typer.echo(f"commands: {bounds}\nabstract states: {', '.join(_names(named))}")
        typer.echo(f"{task}: found no errors in its states, simulator, objective and robot")
        return
    table = Table("task", "commands", "abstract states", "target", "steps/s")
    table.columns[0].no_wrap = True
    for name, known in known_tasks().items():
        table.add_row(
            name if name in TASKS else f"{name} (installed)",
            first_few(list(known.limits), _SHOWN),
            first_few(_names(known), _SHOWN),
            "yes" if known.has_target else "no",
            str(known.fps),
        )
    show_table(table)
    typer.echo(
        "`astra-data tasks TASK` tests one and shows all its values. Name your own task by its place: "
        "cart.py:TASK or package.module:TASK. Its code is run."
    )


def _names(task: "Task") -> Sequence[str]:
    """Return the names of a task's abstract states."""
    return task.abstract_state.names or (f"{task.abstract_state.size} values",)


def label(
    dataset: DatasetName,
    task: Annotated[
        str,
        typer.Option(
            help="A task: a name, or a place such as cart.py:TASK. Its code is run.",
            show_default=False,
        ),
    ],
    seed: Annotated[int, typer.Option(help="Random seed of the goals.")] = 0,
    name: NewName = None,
    out: Out = None,
) -> None:
    """Compute the goals, rewards, successes and failures that a log lacks, as a task defines them."""
    task_at(task)
    from astra_data.dataset.versions import locate

    data = locate(dataset)
    from astra_data.pipeline.display import shown
    from astra_data.pipeline.stages.label import label as label_dataset

    with shown("label") as progress:
        folder = label_dataset(task, data=data, seed=seed, name=name, out=out, progress=progress)
    typer.echo(f"finished: {folder}")
