"""A list of findings that stays readable: of one kind, only the first few are told."""

from collections import Counter
from dataclasses import dataclass, field

MOST = 5
"""Findings of one kind that are told; of the others only the number."""


@dataclass
class _Findings:
    """Sentences by their kind, and how many more of each were not kept."""

    told: dict[str, list[str]] = field(default_factory=dict)
    untold: Counter[str] = field(default_factory=Counter)

    def add(self, kind: str, sentence: str) -> None:
        told = self.told.setdefault(kind, [])
        if len(told) < MOST:
            told.append(sentence)
        else:
            self.untold[kind] += 1

    def sentences(self) -> list[str]:
        found: list[str] = []
        for kind, sentences in self.told.items():
            found += sentences
            if self.untold[kind]:
                found.append(f"{kind}: and {self.untold[kind]} more of this kind")
        return found

    def total(self) -> int:
        return sum(map(len, self.told.values())) + self.untold.total()


@dataclass
class Report:
    """What was found in a dataset.

    Attributes:
        episodes: number of episodes in the data.
        frames: number of steps.
    """

    episodes: int = 0
    frames: int = 0
    _faults: _Findings = field(default_factory=_Findings)
    _notes: _Findings = field(default_factory=_Findings)

    def fault(self, kind: str, sentence: str) -> None:
        """Add something that is wrong."""
        self._faults.add(kind, sentence)

    def note(self, kind: str, sentence: str) -> None:
        """Add something that is worth knowing, but not wrong."""
        self._notes.add(kind, sentence)

    @property
    def faults(self) -> list[str]:
        """What is wrong, a sentence each."""
        return self._faults.sentences()

    @property
    def fault_count(self) -> int:
        """How many things are wrong, also those that `faults` only counts."""
        return self._faults.total()

    @property
    def notes(self) -> list[str]:
        """What is worth knowing, but not wrong, a sentence each."""
        return self._notes.sentences()
