"""Numbers and origins in the words of a Markdown page."""

from collections.abc import Callable, Iterable

from astra_data.results.model import Origin
from astra_data.statistics import Summary


def by_stage(origins: Iterable[Origin], text: Callable[[Origin], str]) -> str:
    """Return what all origins say, or each text with the stages that it holds for."""
    stages: dict[str, list[str]] = {}
    for origin in origins:
        stages.setdefault(text(origin), []).extend(origin.stages)
    if len(stages) == 1:
        return next(iter(stages))
    return "; ".join(f"{said} ({', '.join(dict.fromkeys(of))})" for said, of in stages.items())


def commit(origin: Origin) -> str:
    """Return the commit of the code."""
    if origin.commit is None:
        return "not recorded"
    commit = origin.commit.removesuffix("-dirty")
    return f"commit `{commit}`{' with uncommitted changes' if commit != origin.commit else ''}"


def machine(origin: Origin) -> str:
    """Return the machine."""
    machine = origin.machine
    if machine is None:
        return "not recorded"
    gpu = f", {machine.gpu}" if machine.gpu else ""
    return f"{machine.cpu}, {machine.cores} cores, {machine.memory_gib:g} GiB of memory{gpu}"


def versions(origin: Origin) -> str:
    """Return the versions of the packages."""
    known = (f"{name} {version}" for name, version in origin.packages.items() if version is not None)
    return ", ".join(known) or "not recorded"


def line(cells: Iterable[str]) -> str:
    """Return a line of a Markdown table."""
    return "| " + " | ".join(cells) + " |"


def spread(summary: Summary, digits: int) -> str:
    """Return mean and standard deviation."""
    spread = "" if summary.std is None else f" ± {summary.std:.{digits}f}"
    return f"{summary.mean:.{digits}f}{spread}"


def interval(summary: Summary) -> str:
    """Return the interquartile mean with its 95 % interval."""
    return f"{summary.iqm:.2f}{ends(summary.low, summary.high)}"


def ends(low: float | None, high: float | None) -> str:
    """Return the ends of an interval where there is one."""
    return "" if low is None or high is None else f" [{low:.2f}, {high:.2f}]"


def duration(seconds: float) -> str:
    """Return a time in the unit that suits it."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
