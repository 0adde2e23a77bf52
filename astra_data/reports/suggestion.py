"""What to record next: the map and the tables of a suggestion."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.dataset.columns import Column
from astra_data.reports.formatting import fill
from astra_data.training.proposals import Suggestion
from astra_data.training.recording_plan import PlannedEpisode
from astra_data.worlds.task import Task

CELLS = 24
"""Cells of a map along each axis."""
_LISTED_CELLS, _LEAST_STEPS = 8, 20
"""Cells in the table of a page, and steps that one must have."""


def maps_of(task: Task, suggestion: Suggestion) -> dict[str, dict[str, Any]]:
    """Return what a step teaches on average, by abstract states and by commands.

    Returns:
        "state" and "command", each with "axes" (one or two, with unit), "edges" of the cells along each, and
        "information" in nats and "steps", indexed [first axis, second axis]; the information of cells without
        steps is None. The axes are the first two entries, which in a maze are x and y.
    """
    rollouts, proposals = suggestion.rollouts, suggestion.proposals
    flat = rollouts.reached.flatten().double().numpy()
    worth = rollouts.information.flatten().double().numpy() * flat
    columns = {
        "state": (task.abstract_state, rollouts.state.flatten(0, 1)),
        "command": (_of_commands(task), task.limits.in_units(proposals.action.flatten(0, 1))),
    }
    found = {}
    for name, (column, values) in columns.items():
        shown = values[:, :2].double().numpy()
        edges = [np.linspace(*_ends(each), CELLS + 1) for each in shown.T]
        steps, _ = np.histogramdd(shown, bins=edges, weights=flat)
        taught, _ = np.histogramdd(shown, bins=edges, weights=worth)
        mean = np.where(steps > 0, taught / np.maximum(steps, 1e-9), np.nan)
        found[name] = {
            "axes": with_units(column)[:2],
            "edges": [each.tolist() for each in edges],
            "information": _without_nan(mean.tolist()),
            "steps": steps.tolist(),
        }
    return found


def _without_nan(values: Any) -> Any:  # noqa: ANN401 - nested lists of numbers
    if isinstance(values, list):
        return [_without_nan(one) for one in values]
    return None if np.isnan(values) else values


def _ends(values: Floats) -> tuple[float, float]:
    """Return the range of values (N,), not empty."""
    low, high = float(values.min()), float(values.max())
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _of_commands(task: Task) -> Column:
    """Return the column of commands, with the names of their axes."""
    return Column(task.action.name, size=len(task.limits), names=tuple(task.limits), astra=task.action.astra)


def with_units(column: Column) -> list[str]:
    """Return the names of a column's entries with their units, where these are known."""
    named = zip(column.labels, column.units, strict=True)
    return [name if unit in ("1", "") else f"{name} ({unit})" for name, unit in named]


def suggestion_page(
    task: Task, suggestion: Suggestion, maps: dict[str, dict[str, Any]], *, named: str, origin: Sequence[str]
) -> str:
    """Return the page of a suggestion in Markdown.

    Args:
        task: the task.
        suggestion: what is suggested.
        maps: as `maps_of` returns them.
        named: the task as commands and recipes name it.
        origin: the groundings whose corrections disagree.
    """
    episodes, rollouts = suggestion.plan.episodes, suggestion.rollouts
    expected = rollouts.expected.sum(0).numpy()
    lengths = (rollouts.reached.sum(0) * task.timestep_s).numpy()
    number = len(str(len(episodes)))
    states, commands = with_units(task.abstract_state), with_units(_of_commands(task))
    return (
        fill(
            "suggest.md.jinja",
            task=task,
            named=named,
            origin=origin,
            proposals=len(expected),
            typical=f"{expected.mean():.1f}",
            taken=f"{expected[suggestion.taken].mean():.1f}",
            states=states,
            commands=commands,
            starts=[
                [
                    f"{row:0{number}d}",
                    *(f"{value:.3g}" for value in one.start),
                    f"{one.information:.1f}",
                    f"{lengths[index]:.1f}",
                ]
                for row, (one, index) in enumerate(zip(episodes, suggestion.taken, strict=True))
            ],
            held=[
                [f"{row:0{number}d}" if first else "", *cells]
                for row, one in enumerate(episodes)
                for first, cells in _held(one, task.timestep_s)
            ],
            places=[(maps[name]["axes"], _best_cells(maps[name])) for name in ("state", "command")],
        ).rstrip()
        + "\n"
    )


def _held(one: PlannedEpisode, timestep_s: float) -> list[tuple[bool, list[str]]]:
    """Return a line for each command of an episode: whether it is the first; from when, how long, and it."""
    begins = np.cumsum((0, *one.hold_steps[:-1])) * timestep_s
    return [
        (not index, [f"{begin:.2f}", f"{steps * timestep_s:.2f}", *(f"{value:.3f}" for value in command)])
        for index, (begin, steps, command) in enumerate(
            zip(begins, one.hold_steps, one.commands, strict=True)
        )
    ]


def _best_cells(found: dict[str, Any]) -> list[list[str]]:
    """Return the cells of a map that teach most: their ranges, information in nats, and steps."""
    mean = np.array(found["information"], dtype=np.float64)
    steps = np.array(found["steps"])
    mean[~(steps >= _LEAST_STEPS)] = -np.inf
    lines = []
    for place in np.argsort(-mean, axis=None, kind="stable")[:_LISTED_CELLS]:
        cell = np.unravel_index(place, mean.shape)
        if np.isfinite(mean[cell]):
            ends = [(edges[at], edges[at + 1]) for edges, at in zip(found["edges"], cell, strict=True)]
            ranges = [f"{low:.2f} to {high:.2f}" for low, high in ends]
            lines.append([*ranges, f"{mean[cell]:.3f}", f"{steps[cell]:.0f}"])
    return lines
