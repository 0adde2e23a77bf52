"""What of recordings was dropped, and what is strange about them."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from astra_data.dataset.endings import Endings

Mask = NDArray[np.bool_]


@dataclass
class Tally:
    """How many rows were read and dropped, and why.

    Attributes:
        rows: how many were read.
        rejected_rows: those with a value that is not finite, and those that are torn.
        rejected_first: where the first of those with such a value is.
        torn_rows: those that are cut off at the end of their files. torn_first: where the first of them is.
        split_points: number of boundaries between episodes, by reason.
        last_rows: last rows of episodes, dropped because their next state was not recorded.
        last_terminated: those of them that were terminated.
        last_reward: the sum of the rewards of the others.
        back_rows: those at which time goes back, within a file. back_first: where the first of them is.
        still_rows: those with the time of the row before. still_first: where the first of them is.
        short_rows: rows of episodes that were too short.
        rows_after_end: terminated rows right after a terminated one: the log went on, the episode did not.
        endings: how the episodes end.
        clock: the recorded rate, gaps and jitter, where the mapping names the times.
        unused_fields: fields, or topics, that no column takes.
        notes: what is strange about the rates of files, in a line each.
        topics: what is strange about topics, in a line each, with the files that it is true of.
    """

    rows: int = 0
    rejected_rows: int = 0
    rejected_first: str = ""
    torn_rows: int = 0
    torn_first: str = ""
    split_points: dict[str, int] = field(default_factory=dict)
    last_rows: int = 0
    last_terminated: int = 0
    last_reward: float = 0.0
    back_rows: int = 0
    back_first: str = ""
    still_rows: int = 0
    still_first: str = ""
    short_rows: int = 0
    rows_after_end: int = 0
    endings: Endings = field(default_factory=Endings)
    clock: str = ""
    unused_fields: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    topics: dict[str, list[str]] = field(default_factory=dict)

    def count_torn(self, rows: int, place: str) -> None:
        """Count `rows` that are cut off, at the `place` of the first."""
        self.rows += rows
        self.rejected_rows += rows
        self.torn_rows += rows
        self.torn_first = self.torn_first or place

    def count_times(self, back: Mask, stands: Mask, row_name: Callable[[int], str]) -> None:
        """Count the rows (n,) at which time goes back, or stands still; `row_name` tells where one is."""
        if back.any():
            self.back_first = self.back_first or row_name(int(back.argmax()))
            self.back_rows += int(back.sum())
        if stands.any():
            self.still_first = self.still_first or row_name(int(stands.argmax()))
            self.still_rows += int(stands.sum())
