"""Sections of the page: what the results cost, and where they come from."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from astra_data.methods import method_title
from astra_data.reports.formatting import duration, short, table
from astra_data.reports.schema import Origin, Results

COSTED = ("ground", "train", "align", "evaluate")
"""Stages that are done for a row."""


def cost(results: Results) -> str:
    """Return the section on time and speed."""
    stages = []
    for stage in ("collect", "pair", *COSTED):
        speeds = results.throughput.get(stage, {})
        shown = [f"{_rates(rows)} {_unit(figure)}" for figure, rows in speeds.items() if rows]
        wall, cpu = (spent.get(stage) for spent in (results.wall_seconds, results.cpu_seconds))
        if shown or wall is not None:
            stages.append([stage, duration(wall), duration(cpu), "; ".join(shown)])
    total = (results.wall_seconds["total"], results.cpu_seconds["total"] or None)
    stages.append(["whole recipe", *map(duration, total), ""])
    rows = []
    for row in results.methods.values():
        spent = [row.cost[stage] for stage in COSTED if stage in row.cost]
        cpu_seconds = [stage.cpu_seconds for stage in spent if stage.cpu_seconds is not None]
        rows.append(
            [
                row.title,
                *(duration(row.cost[stage].wall_seconds if stage in row.cost else None) for stage in COSTED),
                duration(sum(stage.wall_seconds for stage in spent)),
                duration(sum(cpu_seconds) if spent and len(cpu_seconds) == len(spent) else None),
            ]
        )
    return (
        "## Cost\n\n"
        + table(["stage", "wall time", "CPU time", "speed"], stages)
        + "\n\nTimes are summed over rows and seeds, which run side by side, with artefacts that rows share "
        "counted once; a dash where a stage recorded none. CPU time: of all threads. Speed: of one item "
        "beside the others, averaged over seeds. Simulator steps/s: the world alone; training steps/s: world "
        "and learning.\n\n"
        + table(["method", *COSTED, "wall time", "CPU time"], rows)
        + "\n\nOne seed of each row, averaged over its seeds, with the grounding and alignment that it uses, "
        "though other rows may share them. What all rows share, `collect` and `pair`, is not in it, nor the "
        "policy of another row that it may go on from."
    )


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


def origin(results: Results) -> str:
    """Return the section on code, machine and datasets."""
    lines = [provenance(results.origins)]
    hashes_of: dict[tuple[str, str, str], list[str]] = {}
    for dataset in results.datasets:
        key = (dataset.stage, dataset.name, dataset.version)
        hashes_of.setdefault(key, []).append(f"`{dataset.content_hash}` (seed {dataset.seed})")
    for (stage, name, version), contents in hashes_of.items():
        lines.append(f"- Dataset of `{stage}`: {name} {version}, content {', '.join(contents)}.")
    for use in results.evaluated_with:
        rows = ", ".join(results.methods[method].title for method in use.methods)
        versions = ", ".join(dict.fromkeys(version for version in use.versions if version is not None))
        hashes = ", ".join(dict.fromkeys(f"`{digest}`" for digest in use.hashes if digest is not None))
        named = f"{versions or 'no dataset'}{f' ({hashes})' if hashes else ''}"
        lines.append(f"- Dataset named by the evaluations of {rows}: {named}.")
    return "## Where this comes from\n\n" + "\n".join(lines)


def provenance(origins: Sequence[Origin]) -> str:
    """Return lines on code, machine and versions."""
    return (
        f"- Code: {_by_stage(origins, _commit)}.\n"
        f"- Machine: {_by_stage(origins, machine)}.\n"
        f"- Versions: {_by_stage(origins, _versions)}."
    )


def _by_stage(origins: Iterable[Origin], text: Callable[[Origin], str]) -> str:
    """Return what all origins say, or each text with the stages that it holds for."""
    stages: dict[str, list[str]] = {}
    for origin in origins:
        stages.setdefault(text(origin), []).extend(origin.stages)
    if len(stages) == 1:
        return next(iter(stages))
    return "; ".join(f"{said} ({', '.join(dict.fromkeys(of))})" for said, of in stages.items())


def _commit(origin: Origin) -> str:
    if origin.commit is None:
        return "not recorded"
    commit = origin.commit.removesuffix("-dirty")
    return f"commit `{commit}`{' with uncommitted changes' if commit != origin.commit else ''}"


def machine(origin: Origin) -> str:
    """Return what is known of a machine."""
    made_on = origin.machine
    if made_on is None:
        return "not recorded"
    gpu = f", {made_on.gpu}" if made_on.gpu else ""
    return f"{made_on.cpu}, {made_on.cores} cores, {made_on.memory_gib:g} GiB of memory{gpu}"


def _versions(origin: Origin) -> str:
    known = (f"{name} {version}" for name, version in origin.packages.items() if version is not None)
    return ", ".join(known) or "not recorded"
