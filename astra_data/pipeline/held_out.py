"""The page of held-out errors that a run writes after its groundings."""

from pathlib import Path

from astra_data.core.naming import reference_of
from astra_data.methods import grounded_as, method_named
from astra_data.pipeline.experiment import Experiment
from astra_data.pipeline.points import Selection
from astra_data.reports.held_out import write_held_out
from astra_data.robots.registry import task_named


def write_errors(experiment: Experiment, selection: Selection) -> Path | None:
    """Write the errors of the groundings that `selection` needs; return the page, None if no row grounds."""
    rows = [*selection.methods, reference_of(experiment.recipe.methods)]
    grounding = dict.fromkeys(grounded_as(row) for row in rows if row and method_named(row).grounds)
    return write_held_out(
        experiment.path.stem,
        experiment.folder,
        tuple(grounding),
        selection.seeds,
        selection.percents,
        timestep_s=task_named(experiment.recipe.task).timestep_s,
    )
