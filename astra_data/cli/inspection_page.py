"""The contents of a dataset for the terminal: all values, where the robot was, and findings."""

from collections.abc import Iterator

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from astra_data.core.arrays import Ints
from astra_data.core.naming import printable
from astra_data.dataset.checkup import Checkup
from astra_data.dataset.inspection import BINS, Inspection, Map, Spread

_BARS = " ▁▂▃▄▅▆▇█"
_SHADES = " ░▒▓█"
_STYLES = {"warning": "yellow", "note": ""}


def inspection_page(inspection: Inspection, checkup: Checkup) -> RenderableType:
    """Lay out an inspection, and below it a check-up."""
    parts: list[RenderableType] = [Text(_summary(inspection)), *_tables(inspection.spreads)]
    if inspection.positions is not None:
        left, right, bottom, top = inspection.positions.extent
        label = f"positions, x {left:.1f} to {right:.1f} m, y {bottom:.1f} to {top:.1f} m"
        parts += [Text(label), Text(shaded(inspection.positions))]
    parts.append(Text("check-up", style="bold"))
    parts += [Text(printable(line)) for line in checkup.summary]
    parts += [Text(printable(str(finding)), style=_STYLES[finding.severity]) for finding in checkup.findings]
    if not checkup.findings:
        parts.append(Text("nothing looks wrong in the values; `astra-data validate` also checks all files"))
    return Group(*parts)


def sparkline(counts: Ints, characters: str = _BARS) -> str:
    """Draw counts (n,) as n bars; only empty bins are blank."""
    levels = np.ceil(counts / max(float(counts.max()), 1e-12) * (len(characters) - 1)).astype(int)
    return "".join(characters[level] for level in levels)


def shaded(planar: Map) -> str:
    """Draw a map as lines of shades, the top first; a character is about as tall as two cells are wide."""
    counts = np.pad(planar.counts, ((0, len(planar.counts) % 2), (0, 0)))
    # Square roots, so that places where the robot rested do not outshine all others.
    pairs = np.sqrt(counts[::2] + counts[1::2])
    drawn, width = sparkline(pairs.ravel(), _SHADES), pairs.shape[1]
    return "\n".join(drawn[at : at + width].rstrip() for at in reversed(range(0, len(drawn), width)))


def _summary(inspection: Inspection) -> str:
    lengths = inspection.lengths
    histogram, _ = np.histogram(lengths, BINS)
    minutes = lengths.sum() / inspection.fps / 60
    lines = [
        f"{inspection.reference}: {len(lengths)} episodes, {lengths.sum():,} steps, {minutes:.1f} min",
        f"lengths {lengths.min()} to {lengths.max()}, median {np.median(lengths):g}  {sparkline(histogram)}",
    ]
    for name, shape in inspection.cameras.items():
        lines.append(f"camera {printable(name)}: {'x'.join(map(str, shape))}")
    if inspection.success is not None:
        share = inspection.success / len(lengths)
        lines.append(f"success {inspection.success} of {len(lengths)} episodes ({share:.2f})")
    if inspection.endings is not None:
        lines.append(f"episodes end: {inspection.endings}")
    return "\n".join(lines)


def _tables(spreads: tuple[Spread, ...]) -> Iterator[RenderableType]:
    """Yield the name of each column and a table of its values, all tables alike in width."""
    width = max(len(name) for spread in spreads for name in (*(spread.column.names or ()), "value"))
    for number, spread in enumerate(spreads):
        column = spread.column
        table = Table(box=None, pad_edge=False, show_header=number == 0)
        table.add_column("value", min_width=width, no_wrap=True)
        table.add_column("unit", min_width=5, no_wrap=True)
        for name in ("min", "mean", "max"):
            table.add_column(name, justify="right", min_width=10, no_wrap=True)
        table.add_column("spread", min_width=BINS, no_wrap=True)
        labels = column.names or [str(index) if column.size > 1 else "" for index in range(column.size)]
        for index, (label, unit) in enumerate(zip(labels, column.units, strict=True)):
            figures = (f"{values[index]:.4g}" for values in (spread.low, spread.mean, spread.high))
            table.add_row(*map(Text, (printable(label), printable(unit), *figures, sparkline(spread.counts[index]))))
        yield Text(f"{printable(column.name)} ({column.size}) {column.dtype}", style="bold")
        yield table
