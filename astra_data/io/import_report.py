"""The result of an import, and what of the recordings was dropped or made up."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from astra_data.core.naming import first_few
from astra_data.dataset.inspection import Endings
from astra_data.io.recording import Block

Mask = NDArray[np.bool_]
_SHOWN = 8
"""Files, fields, and lines on rates, that are listed."""


@dataclass
class Tally:
    """How many rows were read and dropped, and why.

    Attributes:
        rows: how many were read.
        rejected_rows: those with a value that is not finite, and those that are torn.
        rejected_first: where the first of those with such a value is.
        not_finite: field to how many rows it is not finite in, and where the first is.
        bad_episodes: those that are left out for such a row, in a line each.
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
    not_finite: dict[str, tuple[int, str]] = field(default_factory=dict)
    bad_episodes: list[str] = field(default_factory=list)
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

    def count(
        self, block: Block, row: int, bad: Mapping[str, Mask], rejected: Mask, used: Sequence[str]
    ) -> None:
        """Count the rows of `block`, from `row` on of its file.

        Args:
            block: the rows, with fields of which `used` are those of the mapping.
            row: number of the first.
            bad: field to which rows (n,) it is not finite in.
            rejected: which rows have such a field, (n,).
            used: the fields that columns take.
        """
        self.rows += len(block) + block.torn
        self.rejected_rows += int(rejected.sum()) + block.torn
        for name, mask in bad.items():
            first = int(mask.argmax())
            before, place = self.not_finite.get(name) or (0, block.place(first, row + first))
            self.not_finite[name] = before + int(mask.sum()), place
        if rejected.any() and not self.rejected_first:
            first = int(rejected.argmax())
            self.rejected_first = block.place(first, row + first)
        if block.torn:
            self.torn_rows += block.torn
            self.torn_first = self.torn_first or block.row_name(row + len(block))
        known = {*used, *self.unused_fields}
        self.unused_fields += [name for name in block.known if name not in known]
        for note in block.notes:
            self.topics.setdefault(note.removeprefix(f"{block.origin}: "), []).append(block.origin)

    @property
    def faults(self) -> str:
        """Which fields are not finite, and where."""
        rows = self.rows - self.torn_rows
        empty = [name for name, (count, _) in self.not_finite.items() if count == rows]
        parts = [f"{first_few(empty, _SHOWN)} is empty in all {rows} rows: leave it out"] if empty else []
        for name, (count, place) in self.not_finite.items():
            if count < rows:
                parts.append(
                    f"{name} in 1 row, {place}" if count == 1 else f"{name} in {count} rows, first {place}"
                )
        return "; ".join(parts[:_SHOWN]) + (f" and {len(parts) - _SHOWN} more" if len(parts) > _SHOWN else "")


@dataclass(frozen=True)
class ImportReport:
    """Result of an import.

    Attributes:
        root: the dataset's folder.
        episodes: number of episodes.
        frames: number of steps.
        tally: of the rows that were read and dropped.
        wall_seconds: duration of the import.
        unused: the files of which no episode was made.
        unread: the files of folders and archives that have other endings than the format's.
        left_out: what is wrong with each file that was left out.
        taken: which fields became which columns, where no mapping says so.
    """

    root: Path
    episodes: int
    frames: int
    tally: Tally
    wall_seconds: float
    unused: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    taken: str = ""

    def __str__(self) -> str:
        """Summarize it in a few lines."""
        tally = self.tally
        points = ", ".join(f"{reason} {count}" for reason, count in tally.split_points.items()) or "none"
        notes = [f"{first_few(files, 2)}: {note}" for note, files in tally.topics.items()] + tally.notes
        more = [f"and {len(notes) - _SHOWN} more lines on rates"] if len(notes) > _SHOWN else []
        torn = f"; cut off at the end of their files: {tally.torn_rows}, the first is {tally.torn_first}"
        listed = {
            "fields left out": tally.unused_fields,
            "files without an episode": self.unused,
            "files of other endings, not read": self.unread,
        }
        left_out, *others = [f"{what}: {first_few(of, _SHOWN)}" if of else "" for what, of in listed.items()]
        lines = [
            f"{self.root}: {self.episodes} episodes, {self.frames} frames from {tally.rows} rows in "
            f"{self.wall_seconds:.1f} s",
            f"taken without a mapping: {self.taken}" if self.taken else "",
            left_out,
            f"split points: {points}",
            f"episodes end: {tally.endings}" if tally.endings != Endings() else "",
            f"rate: {tally.clock}" if tally.clock else "",
            *notes[:_SHOWN],
            *more,
            f"time stands still in {tally.still_rows} rows, first in {tally.still_first}: expected one row "
            "at a time; they are of several robots, or written twice"
            if tally.still_rows
            else "",
            *others,
            f"files that cannot be imported, left out: {len(self.left_out)}" if self.left_out else "",
            *(f"  {fault}" for fault in self.left_out),
            f"rejected rows: {tally.rejected_rows}{f', {tally.faults}' if tally.not_finite else ''}"
            f"{torn if tally.torn_rows else ''}",
            f"last rows without a next state: {_last_rows(tally)}; "
            f"rows of episodes that were too short: {tally.short_rows}{_after_ends(tally)}",
        ]
        return "\n".join(filter(None, lines))


def losses(tally: Tally) -> str:
    """Say what was dropped, in a line."""
    faults = f" ({tally.faults})" if tally.not_finite else ""
    return (
        f"rows {tally.rows}, rejected {tally.rejected_rows}{faults}, last ones without a next state "
        f"{_last_rows(tally)}, in episodes that were too short {tally.short_rows}{_after_ends(tally)}"
    )


def _after_ends(tally: Tally) -> str:
    return f"; terminated rows after the end, dropped: {tally.rows_after_end}" if tally.rows_after_end else ""


def _last_rows(tally: Tally) -> str:
    parts = [
        f"{tally.last_terminated} of them terminated: the step before takes over how, and the reward"
        if tally.last_terminated
        else "",
        f"with the others a reward of {tally.last_reward:g} in sum" if tally.last_reward else "",
    ]
    lost = ", ".join(filter(None, parts))
    return f"{tally.last_rows} dropped ({lost})" if lost else f"{tally.last_rows} dropped"
