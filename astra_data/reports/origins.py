"""Where results come from: each origin and each choice of datasets once."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from astra_data.core.config import read_written
from astra_data.core.naming import CODE, base_method
from astra_data.methods import grounded_as
from astra_data.reports.schema import DatasetUse, Origin
from astra_data.reports.seed_table import Named


def merged_origins(origins: Iterable[Origin]) -> list[Origin]:
    """Return every code, machine and set of packages once, with all stages that ran there."""
    merged: dict[str, Origin] = {}
    for origin in origins:
        key = origin.model_dump_json(exclude={"stages"})
        known = merged.get(key, origin)
        stages = list(dict.fromkeys([*known.stages, *origin.stages]))
        merged[key] = known.model_copy(update={"stages": stages})
    return list(merged.values())


def recorded_code(root: Path) -> dict[str, str]:
    """Return what the run at `root` recorded of the user's code and its settings; empty where it has none.

    Raises:
        BadInputError: the record is damaged.
    """
    if not (root / CODE).is_file():
        return {}
    advice = "restore it from a copy, or remove it if the code is still what the run was made with"
    return read_written(dict[str, str], root / CODE, by="a run", advice=advice)


def code_of_rows(root: Path, rows: Iterable[str]) -> dict[str, str]:
    """Return the digests that the run at `root` recorded of the code of its task and of methods of `rows`.

    Raises:
        BadInputError: the record is damaged.
    """
    recorded = recorded_code(root)
    named = ["task", *(name for row in rows for name in (base_method(row), grounded_as(row)))]
    return {name: recorded[name] for name in dict.fromkeys(named) if name in recorded}


def dataset_uses(named: Mapping[str, Sequence[Named]]) -> list[DatasetUse]:
    """Return the datasets of each row's seeds, grouped by rows that name the same ones."""
    rows: dict[tuple[Named, ...], list[str]] = {}
    for method, of_seeds in named.items():
        rows.setdefault(tuple(of_seeds), []).append(method)
    return [
        DatasetUse(
            versions=[version for version, _ in of_seeds],
            hashes=[digest for _, digest in of_seeds],
            methods=methods,
        )
        for of_seeds, methods in rows.items()
    ]
