"""Read the intact episodes of a damaged dataset, from files with or without a footer."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.core.errors import CorruptDatasetError, in_short
from astra_data.dataset import columns as names
from astra_data.dataset.digests import Digests, run_alterations
from astra_data.dataset.doctor.footerless import rebuilt_metadata
from astra_data.dataset.format import INFO_PATH
from astra_data.dataset.parquet import UNREADABLE
from astra_data.dataset.plain import (
    PlainColumn,
    Run,
    block_values,
    data_files,
    flag_faults,
    missing_files,
    read_footer,
    read_object,
    read_places,
    run_faults,
    runs,
    schema_faults,
)


def whole_runs(
    folder: Path,
    columns: Sequence[PlainColumn],
    digests: Digests,
    fps: int,
    notes: list[str],
    *,
    repeated: bool = False,
) -> Iterator[tuple[int, Run]]:
    """Yield the uid and the rows of each intact episode; add to `notes` which were left out, and why.

    An episode after rows that are lost is known by its own number and rows, where they agree with
    meta/episodes or, without that, where both are greater than those that should follow.

    Args:
        folder: the damaged dataset.
        columns: the columns to read, LeRobot's own among them.
        digests: those of the values, empty if they are not known; they tell altered episodes from whole ones.
        fps: steps per second.
        notes: a sentence is added for each loss.
        repeated: also yield episodes whose uid an earlier one has.
    """
    info = read_object(folder / INFO_PATH)
    places, faults = read_places(folder, info if isinstance(info, dict) else {})
    notes += [f"meta/episodes was rebuilt from the data: {fault}" for fault in faults]
    if not places and not faults:
        notes.append("meta/episodes was missing and was rebuilt from the data")
    notes += [f"{name} is missing" for name in missing_files(folder, places)]
    counted = info.get("total_episodes") if isinstance(info, dict) else None
    most = len(next(iter(digests.values()))) if digests else counted if isinstance(counted, int) else 2**31
    episode = row = 0
    uids: set[int] = set()
    for run, is_cut in _every_run(folder, columns, notes):
        number, first, frame = _claimed(run)
        place = places.get(number)
        if frame > 0 or (is_cut and (place is None or place.length != len(run))):
            continue  # a part of an episode whose other rows are lost
        is_known = place is not None and place.length == len(run) and place.first_row in (None, first)
        if place is None and number < most:
            is_known = (number > episode and first > row) or (number < episode and first < row)
        if is_known and number < episode:
            notes.append(
                f"left out rows {run.row} to {run.row + len(run) - 1} of {_name(run.path)}: "
                f"they are of episode {number} once more"
            )
            continue
        if is_known and number > episode:
            notes.append(_lost(episode, number - 1))
            episode, row = number, first
        faults = [fault for _, fault in run_faults(run, number=episode, row=row, fps=fps)]
        if (place := places.get(episode)) and place.length != len(run):
            faults.append(f"it has {len(run)} frames, expected {place.length}")
        if episode >= most and digests:
            faults.append(f"expected {most} episodes")
        faults += [*flag_faults(run, episode), *run_alterations(run, episode, digests)]
        uid = int(run.columns.get(names.EPISODE_UID, [episode])[0])
        if uid < 0 or (uid in uids and not repeated):
            faults.append(f"its uid {uid} is taken or negative")
        if faults:
            notes.append(f"left out episode {episode}: {'; '.join(faults)}")
        else:
            uids.add(uid)
            yield uid, run
        episode, row = episode + 1, row + len(run)
    if places and episode <= max(places):
        notes.append(_lost(episode, max(places)))


def _claimed(run: Run) -> tuple[int, int, int]:
    """Return the episode, the first row in the dataset and the first frame that most rows of `run` tell."""
    steps = np.arange(len(run))
    columns = run.columns
    recorded = columns[names.EPISODE_INDEX], columns[names.INDEX] - steps, columns[names.FRAME_INDEX] - steps
    number, first, frame = (int(np.sort(values)[len(run) // 2]) for values in recorded)
    return number, first, frame


def _lost(first: int, last: int) -> str:
    which = f"s {first} to {last}" if last > first else f" {first}"
    return f"left out episode{which}: rows that belong there cannot be read"


def _name(path: Path) -> str:
    """Return the path of a data file inside its dataset."""
    return "/".join(path.parts[-3:])


def _every_run(folder: Path, columns: Sequence[PlainColumn], notes: list[str]) -> Iterator[tuple[Run, bool]]:
    """Yield each run, and whether the rows after it cannot be read."""
    for path in data_files(folder):
        try:
            if isinstance(read_footer(path), str):
                yield from ((run, False) for run in _footerless_runs(path, columns, notes))
            else:
                yield from _footered_runs(path, columns, notes)
        except (*UNREADABLE, CorruptDatasetError) as error:
            notes.append(f"{_name(path)} cannot be read: {in_short(error)}")


def _footered_runs(
    path: Path, columns: Sequence[PlainColumn], notes: list[str]
) -> Iterator[tuple[Run, bool]]:
    """Yield the runs of a file with a footer, and whether the rows after each cannot be read."""
    with pq.ParquetFile(path) as file:
        counts = [file.metadata.row_group(group).num_rows for group in range(file.num_row_groups)]
        group = 0
        while group < len(counts):
            rows: list[int] = []
            faults: list[str] = []
            held: Run | None = None
            first = sum(counts[:group])
            for run in runs(path, _row_groups(file, columns, group, rows, faults), columns):
                if held is not None:
                    yield held, False
                held = replace(run, row=first + run.row)
            if held is not None:
                yield held, bool(faults)
            if faults:
                lost = first + sum(rows)
                notes.append(
                    f"{_name(path)} rows {lost} to {lost + counts[group + len(rows)] - 1} "
                    f"cannot be read ({faults[0]})"
                )
            group += len(rows) + 1


def _footerless_runs(path: Path, columns: Sequence[PlainColumn], notes: list[str]) -> Iterator[Run]:
    schema = pa.schema([(column.name, column.arrow_type) for column in columns])
    metadata = rebuilt_metadata(path, schema)
    rows: list[int] = []
    held: Run | None = None
    with pq.ParquetFile(path, metadata=metadata) as file:
        for run in runs(path, _row_groups(file, columns, 0, rows, []), columns):
            if held is not None:
                yield held
            held = run
    notes.append(f"{_name(path)} has no footer: {len(rows)} whole row groups were found in it")
    # LeRobot writes one row group per episode. With other groups, the last episode may be incomplete.
    if held is not None and len(held) == rows[-1]:
        yield held
    elif held is not None:
        notes.append(
            f"the last {len(held)} frames in {path.name} may be part of an episode and were left out"
        )


def _row_groups(
    file: pq.ParquetFile,
    columns: Sequence[PlainColumn],
    first: int,
    rows: list[int],
    faults: list[str],
) -> Iterator[pa.Table]:
    """Yield row groups from `first` up to an unreadable one.

    Their numbers of rows are appended to `rows`, and what is wrong with the unreadable one to `faults`.
    """
    for group in range(first, file.num_row_groups):
        try:
            table = file.read_row_group(group, columns=[column.name for column in columns], use_threads=False)
            if not schema_faults(table.schema, columns):
                block_values(table, columns)
        except (*UNREADABLE, CorruptDatasetError) as error:
            faults.append(in_short(error))
            return
        rows.append(table.num_rows)
        yield table
