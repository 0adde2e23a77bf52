"""The findings of a check: of each kind, the first few in words and the others counted."""

from collections import Counter
from dataclasses import dataclass, field

MOST = 5
"""Findings of one kind that are kept; further ones are only counted."""


class _Findings:
    """Sentences by kind, the first `MOST` of each, and the number of all."""

    def __init__(self) -> None:
        self.kept: dict[str, list[str]] = {}
        self.counts: Counter[str] = Counter()

    def add(self, kind: str, sentence: str) -> None:
        self.counts[kind] += 1
        if self.counts[kind] <= MOST:
            self.kept.setdefault(kind, []).append(sentence)

    def sentences(self) -> list[str]:
        found: list[str] = []
        for kind, sentences in self.kept.items():
            found += sentences
            if more := self.counts[kind] - len(sentences):
                found.append(f"{kind}: and {more} more of this kind")
        return found


@dataclass
class Report:
    """The findings in a dataset.

    Attributes:
        episodes: number of episodes in the data.
        frames: number of steps.
    """

    episodes: int = 0
    frames: int = 0
    _faults: _Findings = field(default_factory=_Findings)
    _notes: _Findings = field(default_factory=_Findings)

    def fault(self, kind: str, sentence: str) -> None:
        """Add a fault."""
        self._faults.add(kind, sentence)

    def note(self, kind: str, sentence: str) -> None:
        """Add something worth knowing that is not a fault."""
        self._notes.add(kind, sentence)

    @property
    def faults(self) -> list[str]:
        """The faults, a sentence each."""
        return self._faults.sentences()

    @property
    def fault_count(self) -> int:
        """The number of faults, including those that `faults` only counts."""
        return self._faults.counts.total()

    @property
    def notes(self) -> list[str]:
        """The notes, a sentence each."""
        return self._notes.sentences()
