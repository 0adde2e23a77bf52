"""The page of what paired episodes say before any fit."""

import numpy as np

from astra_data.core.arrays import Floats
from astra_data.core.naming import in_code
from astra_data.grounding.diagnosis import Diagnosis, with_ends
from astra_data.reports.blocks import Section, TableBlock, Text, markdown
from astra_data.reports.statistics import Estimate, interval

DIAGNOSIS = "diagnosis.md"
_BARS = " ▁▂▃▄▅▆▇█"


def diagnosis_page(recipe: str, found: Diagnosis, timestep_s: float) -> str:
    """Return the page of a diagnosis in Markdown."""
    findings = [f"**{one.what}**: {one.advice}." for one in found.findings]
    delays = [
        [
            one.name,
            interval(Estimate(*one.delay_s), 3) if one.is_visible else "-",
            interval(Estimate(*one.gain), 3),
            _bars(one.weights),
        ]
        for one in found.responses
    ]
    missed = [
        [one.name, one.unit or "1", f"{one.error:.3g}", f"{one.still:.3g}", one.where or "everywhere alike"]
        for one in found.missed
    ]
    about = Text(
        f"What {in_code(found.reference)} ({found.recordings} recordings, {found.steps} steps) and the abstract "
        "simulator say before anything is fitted."
    )
    given = [[name, *(f"{value:.3g}" for value in ends)] for name, ends in found.commands.items()]
    shape = f"response by step of {timestep_s:g} s"
    meaning = Text(
        "The robot's motion as a sum of what the simulator does for the present and the past commands: effect is the "
        "sum of their shares (1: as much as in the simulator), delay their mean lag, dead time and time constant "
        "together. Intervals are a bootstrap over recordings."
    )
    given_head = ["command", "1 % lie below", "99 % lie below", "lower bound", "upper bound"]
    delay_head = ["command", "delay (s) [95 %]", "effect [95 %]", shape]
    missed_head = ["value", "unit", "error (RMS)", "no motion (persistence baseline)", "where"]
    sections = [
        Section("", [about, Text("" if findings else "Nothing that needs attention.", findings)]),
        Section("Delay of each command", [TableBlock("", delay_head, delays), meaning]),
        Section("Commands that were given", [TableBlock("", given_head, given)]),
        Section("What the simulator misses, one step ahead", [TableBlock("", missed_head, missed, words=2)]),
    ]
    if found.explained:
        lines = [[name, interval(Estimate(*with_ends(value)))] for name, value in found.explained.items()]
        text = (
            "R² on held-out recordings (0: nothing, 1: all of it), mean over the values that it misses, of a "
            "ridge regression on the values, and on the products of two where there are few. What each line explains "
            "beyond the one above: past commands, a delay or a lag; past errors, other state that is hidden."
        )
        table = TableBlock("", ["from", "explained [95 %]"], lines)
        sections.append(Section("What explains that error", [table, Text(text)]))
    if found.forecast:
        sizes, left = found.forecast.sizes, found.forecast.left
        lines = [
            [f"{size}", *(f"{value:.2f}" for value in np.percentile(of, [50, 2.5, 97.5]))]
            for size, of in zip(sizes, left, strict=True)
        ]
        lines.append([f"{found.forecast.more} (forecast)", *(f"{value:.2f}" for value in found.forecast.expected)])
        text = (
            "Share of the simulator's squared error that a ridge regression on histories leaves on held-out "
            "recordings, refitted to random ones: those of the "
            f"{found.recordings} that are long enough. A grounding leaves less, and what it leaves falls alike."
        )
        table = TableBlock("", ["recordings", "left", "2.5 %", "97.5 %"], lines)
        sections.append(Section("Enough recordings?", [table, Text(text)]))
    return markdown(f"{recipe}: before any fit", sections)


def _bars(weights: Floats) -> str:
    """Draw the shares of a response by lag, without the last that are empty."""
    most = max(float(weights.max()), 1e-12)
    levels = [round(max(float(weight), 0.0) / most * (len(_BARS) - 1)) for weight in weights]
    return "".join(_BARS[level] for level in levels).rstrip()
