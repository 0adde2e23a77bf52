"""Read the intact episodes of a damaged dataset, from files with or without a footer."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset import columns as names
from astra_data.dataset.digests import Digests, run_alterations
from astra_data.dataset.doctor.footerless import rebuilt_metadata
from astra_data.dataset.parquet import UNREADABLE, read_blocks
from astra_data.dataset.plain import (
    PlainColumn,
    Run,
    data_files,
    episodes_files,
    flag_faults,
    read_footer,
    run_faults,
    runs,
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
    every = (run for path in data_files(folder) for run in _file_runs(path, columns, notes))
    try:
        for run in every:
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


def _file_runs(path: Path, columns: Sequence[PlainColumn], notes: list[str]) -> Iterator[Run]:
    wanted = [column.name for column in columns]
    if not isinstance(read_footer(path), str):
        yield from runs(path, read_blocks([path], wanted), columns)
        return
    schema = pa.schema([(column.name, column.arrow_type) for column in columns])
    metadata = rebuilt_metadata(path, schema)
    rows: list[int] = []
    held: Run | None = None
    for run in runs(path, _row_groups(path, metadata, wanted, rows), columns):
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
    path: Path, metadata: pq.FileMetaData, wanted: Sequence[str], rows: list[int]
) -> Iterator[pa.Table]:
    """Yield row groups up to the first unreadable one, and append their numbers of rows to `rows`."""
    with pq.ParquetFile(path, metadata=metadata) as file:
        for group in range(metadata.num_row_groups):
            try:
                table = file.read_row_group(group, columns=wanted, use_threads=False)
            except UNREADABLE:
                return
            rows.append(table.num_rows)
            yield table
