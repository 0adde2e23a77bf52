"""A list of findings that stays readable: of one kind, only the first few are told."""

from collections import Counter
from dataclasses import dataclass, field

MOST = 5
"""Findings of one kind that are told; of the others only the number."""


@dataclass
class Report:
    """What was found in a dataset.

    Attributes:
        episodes: number of episodes in the data.
        frames: number of steps.
    """

    episodes: int = 0
    frames: int = 0
    _faults: dict[str, list[str]] = field(default_factory=dict)
    _notes: dict[str, list[str]] = field(default_factory=dict)
    _untold: Counter[str] = field(default_factory=Counter)

    def fault(self, kind: str, sentence: str) -> None:
        """Add something that is wrong."""
        self._add(self._faults, kind, sentence)

    def note(self, kind: str, sentence: str) -> None:
        """Add something that is worth knowing, but not wrong."""
        self._add(self._notes, kind, sentence)

    @property
    def faults(self) -> list[str]:
        """What is wrong, a sentence each."""
        return self._told(self._faults)

    @property
    def notes(self) -> list[str]:
        """What is worth knowing, but not wrong, a sentence each."""
        return self._told(self._notes)

    def _add(self, findings: dict[str, list[str]], kind: str, sentence: str) -> None:
        told = findings.setdefault(kind, [])
        if len(told) < MOST:
            told.append(sentence)
        else:
            self._untold[kind] += 1

    def _told(self, findings: dict[str, list[str]]) -> list[str]:
        told: list[str] = []
        for kind, sentences in findings.items():
            told += sentences
            if self._untold[kind]:
                told.append(f"{kind}: and {self._untold[kind]} more of this kind")
        return told
