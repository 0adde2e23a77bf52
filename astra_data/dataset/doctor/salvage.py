"""Read the intact episodes of a damaged dataset, from files with or without a footer."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.core.errors import CorruptDatasetError, in_short
from astra_data.dataset import columns as names
from astra_data.dataset.digests import Digests, run_alterations
from astra_data.dataset.doctor.footerless import rebuilt_metadata
from astra_data.dataset.parquet import UNREADABLE, read_blocks
from astra_data.dataset.plain import (
    PlainColumn,
    Run,
    block_values,
    data_files,
    episodes_files,
    flag_faults,
    read_footer,
    run_faults,
    runs,
    schema_faults,
)

_STRUCTURE = {*(names.INDEX, names.EPISODE_INDEX, names.FRAME_INDEX), *(names.TIMESTAMP, names.EPISODE_UID)}
"""Columns that locate episodes: after a fault in one, no later episode can be trusted without digests."""


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

    Args:
        folder: the damaged dataset.
        columns: the columns to read, LeRobot's own among them.
        digests: those of the values, empty if they are not known; they tell altered episodes from whole ones.
        fps: steps per second.
        notes: a sentence is added for each loss.
        repeated: also yield episodes whose uid an earlier one has.
    """
    lengths = _lengths(folder, notes)
    episode = row = 0
    uids: set[int] = set()
    try:
        for run, start, is_cut in _every_run(folder, columns, notes):
            if is_cut and lengths.get(episode) != len(run):
                continue
            if start > row:  # the rows between belong to episodes that cannot be read
                if run.columns[names.FRAME_INDEX][0]:
                    continue
                number = int(run.columns[names.EPISODE_INDEX][0])
                if episode < number <= episode + start - row:
                    which = f"s {episode} to {number - 1}" if number > episode + 1 else f" {episode}"
                    notes.append(f"left out episode{which}: rows that belong there cannot be read")
                    episode = number
                row = start
            found = list(run_faults(run, number=episode, row=row, fps=fps))
            structural = [] if digests else [fault for name, fault in found if name in _STRUCTURE]
            if lengths.get(episode, len(run)) != len(run):
                structural.append(f"episode {episode} has {len(run)} frames, expected {lengths[episode]}")
            if structural:
                notes.append(f"stopped before episode {episode}: {'; '.join(structural)}")
                return
            faults = [*(fault for _, fault in found), *flag_faults(run, episode)]
            faults += run_alterations(run, episode, digests)
            uid = int(run.columns.get(names.EPISODE_UID, [episode])[0])
            if uid < 0 or (uid in uids and not repeated):
                faults.append(f"its uid {uid} is taken or negative")
            if faults:
                notes.append(f"left out episode {episode}: {'; '.join(faults)}")
            else:
                uids.add(uid)
                yield uid, run
            episode, row = episode + 1, row + len(run)
    except CorruptDatasetError as error:
        notes.append(f"stopped before episode {episode}: {error}")


def _lengths(folder: Path, notes: list[str]) -> dict[int, int]:
    """Return the episodes' lengths from meta/episodes, as far as it can be read."""
    lengths: dict[int, int] = {}
    before = len(notes)
    for path in episodes_files(folder):
        try:
            for block in read_blocks([path], ["episode_index", "length"]):
                columns = block.to_pydict()
                lengths |= zip(columns["episode_index"], columns["length"], strict=True)
        except (CorruptDatasetError, KeyError, TypeError) as error:
            notes.append(f"meta/episodes was rebuilt from the data: {error}")
    if not lengths and len(notes) == before:
        notes.append("meta/episodes was missing and was rebuilt from the data")
    return lengths


def _every_run(
    folder: Path, columns: Sequence[PlainColumn], notes: list[str]
) -> Iterator[tuple[Run, int, bool]]:
    """Yield each run, its first row in the dataset, and whether the rows after it cannot be read."""
    base = 0
    for path in data_files(folder):
        footer = read_footer(path)
        if isinstance(footer, str):
            for run in _footerless_runs(path, columns, notes):
                yield run, base, False
                base += len(run)
        else:
            for run, is_cut in _footered_runs(path, columns, notes):
                yield run, base + run.row, is_cut
            base += footer[0]


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
                    f"{path.parent.name}/{path.name} rows {lost} to {lost + counts[group + len(rows)] - 1} "
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
    notes.append(
        f"{path.parent.name}/{path.name} has no footer: {len(rows)} whole row groups were found in it"
    )
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
