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
            "Each row was tested in the simulator it was trained in: its own grounded one, or the raw one "
            "if it has no grounding. So the numbers show what it learned, not whether it transfers. Add a "
            "row of NAS to test all rows in one simulator."
        )
    else:
        there = [method_title(row) for row in results.methods if grounded_as(row) == reference]
        place = (
            f"All rows were tested in the abstract simulator grounded by {method_title(reference)}, in which "
            f"only {' and '.join(there)} trained. It cannot show what is not in the abstract state."
        )
    return f"**Nothing was tested on a robot: the task has no target.** {place}"
