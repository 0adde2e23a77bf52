"""Whether a dataset has the columns that a task expects."""

from collections.abc import Iterable

from astra_data.dataset.columns import Column
from astra_data.dataset.reader import Dataset


def column_faults(source: Dataset, expected: Column, task: str) -> list[str]:
    """List how a column of a dataset is of another size, in another order or in other units than a task's."""
    if expected.name not in source.features:
        return [f"has no column {expected.name}"]
    recorded = Column.from_feature(expected.name, source.features[expected.name])
    if recorded.size != expected.size:
        return [f"{expected.name} has {recorded.size} values, expected those of {task}: {expected.size}"]
    faults, names = [], recorded.names or ()
    if any(name in names and names.index(name) != place for place, name in enumerate(expected.names or ())):
        order = ", ".join(expected.labels)
        faults.append(f"has the values {', '.join(names)} in {expected.name}, expected the order {order}")
    for name, own, other in zip(recorded.labels, recorded.units, expected.units, strict=True):
        if own and other and own != other:
            faults.append(f"has {name} of {expected.name} in {own}, expected {other}: scale it on import")
    return faults


def names_apart(source: Dataset, expected: Iterable[Column], task: str) -> str:
    """Say which columns of a dataset, where they fit, have no name that the task has; empty if none."""
    apart = []
    for column in expected:
        recorded = Column.from_feature(column.name, source.features[column.name])
        if column.names and not {*(recorded.names or ())} & {*column.names}:
            given = ", ".join(recorded.names or ["values without names"])
            apart.append(f"{given} of {column.name} as {', '.join(column.names)}")
    if not apart:
        return ""
    return f"{source.reference}: takes {' and '.join(apart)} of {task}: check that they are, in this order"
