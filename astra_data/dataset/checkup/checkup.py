"""Check a dataset up in one pass: how episodes end, which commands were given, its rate, and findings."""

from dataclasses import dataclass
from typing import Any, Protocol

from astra_data.dataset.checkup.angles import Angles
from astra_data.dataset.checkup.clock import Clock, is_clock
from astra_data.dataset.checkup.commands import GivenCommands
from astra_data.dataset.checkup.continuity import Continuity
from astra_data.dataset.checkup.dead import DeadChannels
from astra_data.dataset.checkup.duplicates import Duplicates
from astra_data.dataset.checkup.ends import EpisodeEnds
from astra_data.dataset.checkup.finding import Finding
from astra_data.dataset.checkup.jumps import Jumps
from astra_data.dataset.checkup.outliers import Outliers
from astra_data.dataset.checkup.rows import Repeats, Shift
from astra_data.dataset.columns import ACTION, NEXT_STATE, REWARD, STATE, TERMINATED, Episode
from astra_data.dataset.reader import Dataset

LOOKED_AT = (STATE, ACTION, NEXT_STATE, REWARD, TERMINATED)


class _Part(Protocol):
    """One question that is asked of every episode."""

    def add(self, episode: Episode) -> None:
        """Take the next episode."""


@dataclass(frozen=True)
class Checkup:
    """What a check-up found.

    Attributes:
        reference: name and version of the dataset.
        summary: a line each on how episodes end, on commands and on the rate.
        findings: warnings first.
    """

    reference: str
    summary: tuple[str, ...]
    findings: tuple[Finding, ...]

    def record(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {
            "dataset": self.reference,
            "summary": list(self.summary),
            "findings": [finding.record() for finding in self.findings],
        }


def check_up(dataset: Dataset, called: str | None = None) -> Checkup:
    """Look at all episodes of `dataset`, one at a time; those with large steps twice.

    Args:
        dataset: any.
        called: how commands are to call it, by default its name and version.

    Raises:
        CorruptDatasetError: a file cannot be read.
    """
    called = called or dataset.reference
    fps, successes = int(dataset.info["fps"]), dataset.successes()
    columns = {column.name: column for column in dataset.schema}
    clocks = [Clock.of(column, fps) for column in columns.values() if is_clock(column)]
    ends, duplicates, continuity = EpisodeEnds(successes), Duplicates(), Continuity()
    dead = DeadChannels(list(columns.values()))
    outliers = Outliers(columns.get(STATE), successes)
    commands = GivenCommands(columns[ACTION], fps) if ACTION in columns else None
    jumps = Jumps(columns[STATE], int(dataset.lengths.sum())) if STATE in columns else None
    angles = Angles(columns[STATE]) if STATE in columns else None
    names = [column.name for column in columns.values() if column.name in LOOKED_AT or is_clock(column)]
    repeats, shift = Repeats(), Shift()
    parts: list[_Part] = [ends, duplicates, continuity, dead, outliers, repeats, shift, *clocks]
    parts += [part for part in (commands, jumps, angles) if part is not None]
    for episode in dataset.episodes(names or list(columns)):
        for part in parts:
            part.add(episode)
    mcap = _is_of_mcap(dataset)
    findings = [finding for clock in clocks for finding in clock.findings(called, mcap=mcap)]
    findings += _of_import(dataset) + repeats.findings() + shift.findings()
    findings += angles.findings() if angles else []
    findings += jumps.findings(dataset, called) if jumps else []
    findings += continuity.findings() + duplicates.findings(called)
    findings += dead.findings(called) + outliers.findings(called)
    findings += (commands.findings() if commands else []) + ends.findings()
    rates = [str(clock) for clock in clocks] or [f"{fps} Hz declared; no time column to compare it with"]
    summary = [f"endings: {ends}"]
    summary += [f"commands: {commands}"] if commands else []
    summary += [f"rate: {rate}" for rate in rates]
    findings.sort(key=lambda finding: finding.severity != "warning")
    return Checkup(dataset.reference, tuple(summary), tuple(findings))


def _of_import(dataset: Dataset) -> list[Finding]:
    """Return what the import said of rates and of rounding, where the dataset is one."""
    notes, topics = (dataset.description.get(key) for key in ("notes", "topics"))
    found = [*(notes if isinstance(notes, list) else []), *(topics if isinstance(topics, dict) else [])]
    return [
        Finding("warning", f"at import, {note}", "correct the mapping and import again") for note in found
    ]


def _is_of_mcap(dataset: Dataset) -> bool | None:
    """Return whether all episodes were imported from MCAP, by their files' names; None if it is not known."""
    if dataset.description.get("config", {}).get("format") == "mcap":
        return True
    sources = [source for source in dataset.metadata.get("source", ()) if isinstance(source, str)]
    kinds = {source.lower().endswith(".mcap") for source in sources}
    return kinds.pop() if len(kinds) == 1 and len(sources) == len(dataset) else None
