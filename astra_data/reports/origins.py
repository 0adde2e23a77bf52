"""Where results come from: each origin and each choice of datasets once."""

from collections.abc import Iterable, Mapping, Sequence

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
