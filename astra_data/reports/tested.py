"""Where the rows of results were tested: in the target or, of a task without one, in simulators."""

from astra_data.core.naming import reference_of
from astra_data.methods import grounded_as, method_title
from astra_data.reports.schema import Results


def where(results: Results) -> str:
    """Return the words for it that follow a score."""
    if results.tested_in == "target":
        return "in the target"
    reference = reference_of(results.methods)
    return f"in the simulator grounded by {method_title(reference)}" if reference else "in a simulator"


def warning(results: Results) -> str:
    """Return what is said before all else of results that are of no target; empty for others."""
    if results.tested_in == "target":
        return ""
    reference = reference_of(results.methods)
    if reference is None:
        place = (
            "each row in its own grounded simulator, or in the raw one where it grounds none: in the very "
            "simulator that it was trained in, so the figures say what it learned, not whether it transfers. "
            "With a row of NAS, all would be tested in one simulator."
        )
    else:
        there = [method_title(row) for row in results.methods if grounded_as(row) == reference]
        place = (
            f"the abstract simulator as {method_title(reference)} grounded it, in which no row was trained "
            f"but {' and '.join(there)}. What is in no abstract state, it cannot show."
        )
    return f"**Nothing was tested on a robot: the task has no target.** Figures were measured in {place}"
