"""What results cost and where they come from, as text."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from astra_data.methods import method_title
from astra_data.reports.costs import DATASET_STAGES
from astra_data.reports.formatting import duration, short
from astra_data.reports.schema import Origin, Results

COSTED = ("ground", "train", "align", "evaluate")
"""Stages that run once for each row and seed."""


def stage_costs(results: Results) -> list[list[str]]:
    """Return lines of wall time, CPU time and speed by stage, and of the whole recipe."""
    lines = []
    for stage in (*DATASET_STAGES, *COSTED[:-1], "select", COSTED[-1]):
        speeds = results.throughput.get(stage, {})
        shown = [f"{_rates(rows)} {_unit(figure)}" for figure, rows in speeds.items() if rows]
        wall, cpu = (spent.get(stage) for spent in (results.wall_seconds, results.cpu_seconds))
        if shown or wall is not None:
            lines.append([stage, duration(wall), duration(cpu), "; ".join(shown)])
    total = (results.wall_seconds["total"], results.cpu_seconds["total"] or None)
    return [*lines, ["whole recipe", *map(duration, total), ""]]


def row_costs(results: Results) -> list[list[str]]:
    """Return lines of each row's wall time by stage, and its wall and CPU time in all."""
    lines = []
    for row in results.methods.values():
        spent = [row.cost[stage] for stage in COSTED if stage in row.cost]
        cpu_seconds = [stage.cpu_seconds for stage in spent if stage.cpu_seconds is not None]
        lines.append(
            [
                row.title,
                *(duration(row.cost[stage].wall_seconds if stage in row.cost else None) for stage in COSTED),
                duration(sum(stage.wall_seconds for stage in spent)),
                duration(sum(cpu_seconds) if spent and len(cpu_seconds) == len(spent) else None),
            ]
        )
    return lines


def _rates(rows: Mapping[str, list[float]]) -> str:
    means = {method_title(method): float(np.mean(values)) for method, values in rows.items()}
    slowest, fastest = min(means, key=means.__getitem__), max(means, key=means.__getitem__)
    if short(means[slowest]) == short(means[fastest]):
        return short(means[slowest])
    return f"{short(means[slowest])} ({slowest}) to {short(means[fastest])} ({fastest})"


def _unit(figure: str) -> str:
    """Return "target steps/s" for "target_steps_per_second"; bare steps are those of a training."""
    steps = figure.removesuffix("_per_second").replace("_", " ")
    return f"{'training ' if steps == 'steps' else ''}{steps}/s"


def dataset_lines(results: Results) -> list[str]:
    """Return a sentence on each dataset that the recipe wrote, and on those that its evaluations name."""
    lines = []
    hashes_of: dict[tuple[str, str, str], list[str]] = {}
    for dataset in results.datasets:
        key = (dataset.stage, dataset.name, dataset.version)
        hashes_of.setdefault(key, []).append(f"`{dataset.content_hash}` (seed {dataset.seed})")
    for (stage, name, version), contents in hashes_of.items():
        lines.append(f"Dataset of `{stage}`: {name} {version}, content {', '.join(contents)}.")
    for use in results.evaluated_with:
        rows = ", ".join(results.methods[method].title for method in use.methods)
        versions = ", ".join(dict.fromkeys(version for version in use.versions if version is not None))
        hashes = ", ".join(dict.fromkeys(f"`{digest}`" for digest in use.hashes if digest is not None))
        named = f"{versions or 'no dataset'}{f' ({hashes})' if hashes else ''}"
        lines.append(f"Dataset named by the evaluations of {rows}: {named}.")
    return lines


def provenance(origins: Sequence[Origin], own_code: Mapping[str, str]) -> dict[str, str]:
    """Return the text on code, machine and versions, and on the user's code where there is some."""
    texts = {"code": _commit, "machine": machine, "versions": _versions}
    shared = {what: _by_stage(origins, text) for what, text in texts.items()}
    own = ", ".join(f"{name} `{digest}`" for name, digest in own_code.items())
    return shared | {"own_code": own} if own else shared


def _by_stage(origins: Iterable[Origin], text: Callable[[Origin], str]) -> str:
    """Return the text that all origins share, or each text with its stages."""
    stages: dict[str, list[str]] = {}
    for origin in origins:
        stages.setdefault(text(origin), []).extend(origin.stages)
    if len(stages) == 1:
        return next(iter(stages))
    return "; ".join(f"{shared} ({', '.join(dict.fromkeys(of))})" for shared, of in stages.items())


def _commit(origin: Origin) -> str:
    if origin.commit is None:
        return "not recorded"
    commit = origin.commit.removesuffix("-dirty")
    return f"commit `{commit}`{' with uncommitted changes' if commit != origin.commit else ''}"


def machine(origin: Origin) -> str:
    """Return processor, cores, memory and GPU of an origin's machine."""
    made_on = origin.machine
    if made_on is None:
        return "not recorded"
    gpu = f", {made_on.gpu}" if made_on.gpu else ""
    return f"{made_on.cpu}, {made_on.cores} cores, {made_on.memory_gib:g} GiB of memory{gpu}"


def machines(origins: Iterable[Origin]) -> str:
    """Return the text on each machine once, with its GPU where some origin used it."""
    texts = dict.fromkeys(map(machine, origins))
    return " and ".join(text for text in texts if not any(other.startswith(f"{text}, ") for other in texts))


def _versions(origin: Origin) -> str:
    known = (f"{name} {version}" for name, version in origin.packages.items() if version is not None)
    return ", ".join(known) or "not recorded"
