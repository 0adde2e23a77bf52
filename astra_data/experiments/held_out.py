"""The page of held-out errors that ends a run which stops at its groundings."""

from pathlib import Path

from astra_data.core.naming import base_method, reference_of
from astra_data.experiments.experiment import Experiment
from astra_data.experiments.plan import grounded_as
from astra_data.experiments.points import Selection
from astra_data.methods import METHODS
from astra_data.reports.held_out import write_held_out
from astra_data.worlds.registry import task_named


def write_errors(experiment: Experiment, selection: Selection) -> Path | None:
    """Write the errors of the groundings of `selection`; return the page, None if no row grounds."""
    bases = [*map(base_method, selection.methods), reference_of(selection.methods)]
    grounding = dict.fromkeys(grounded_as(base) for base in bases if base and METHODS[base].grounds)
    return write_held_out(
        experiment.path.stem,
        experiment.folder,
        tuple(grounding),
        selection.seeds,
        selection.percents,
        timestep_s=task_named(experiment.recipe.task).timestep_s,
    )
