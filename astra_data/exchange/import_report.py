"""The result of an import, and what of the recordings was dropped or made up."""

from dataclasses import dataclass
from pathlib import Path

from astra_data.core.wording import first_few
from astra_data.dataset.endings import Endings
from astra_data.exchange.tally import Tally

_SHOWN = 8
"""Files, and lines on rates, that are listed."""


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
        first = f", the first is {tally.rejected_first}" if tally.rejected_first else ""
        if tally.torn_rows:
            first += (
                f"; cut off at the end of their files: {tally.torn_rows}, the first is {tally.torn_first}"
            )
        taken = f"taken without a mapping: {self.taken}\n" if self.taken else ""
        if tally.unused_fields:
            taken += f"fields left out: {first_few(tally.unused_fields, _SHOWN)}\n"
        ends = f"episodes end: {tally.endings}\n" if tally.endings != Endings() else ""
        rate = f"rate: {tally.clock}\n" if tally.clock else ""
        lines = [f"{first_few(files, 2)}: {note}" for note, files in tally.topics.items()] + tally.notes
        notes = "".join(f"{line}\n" for line in lines[:_SHOWN])
        if len(lines) > _SHOWN:
            notes += f"and {len(lines) - _SHOWN} more lines on rates\n"
        still = (
            f"time stands still in {tally.still_rows} rows, first in {tally.still_first}: expected one row "
            "at a time; they are of several robots, or written twice\n"
            if tally.still_rows
            else ""
        )
        unused = f"files without an episode: {first_few(self.unused, _SHOWN)}\n" if self.unused else ""
        if self.unread:
            unused += f"files of other endings, not read: {first_few(self.unread, _SHOWN)}\n"
        if self.left_out:
            faults = "".join(f"  {fault}\n" for fault in self.left_out)
            unused += f"files that cannot be imported, left out: {len(self.left_out)}\n{faults}"
        return (
            f"{self.root}: {self.episodes} episodes, {self.frames} frames "
            f"from {tally.rows} rows in {self.wall_seconds:.1f} s\n"
            f"{taken}split points: {points}\n"
            f"{ends}{rate}{notes}{still}{unused}"
            f"rejected rows: {tally.rejected_rows}{first}\n"
            f"last rows without a next state: {_last_rows(tally)}; "
            f"rows of episodes that were too short: {tally.short_rows}{_after_ends(tally)}"
        )


def losses(tally: Tally) -> str:
    """Say what was dropped, in a line."""
    return (
        f"rows {tally.rows}, rejected {tally.rejected_rows}, last ones without a next state "
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
