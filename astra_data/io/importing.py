"""Import recordings in other formats as datasets."""

import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from astra_data.core.config import did_you_mean, only_given, validated
from astra_data.core.durable import files_below
from astra_data.core.errors import AstraDataError, BadInputError, in_short
from astra_data.core.naming import first_few
from astra_data.dataset.columns import TRUNCATED, Episode
from astra_data.dataset.versions import home_of
from astra_data.dataset.writer import DatasetWriter, is_text
from astra_data.io.cutting import Cut, Cutter
from astra_data.io.export_record import ExportRecord, read_record, restored, write_restored
from astra_data.io.import_report import ImportReport, Tally, losses
from astra_data.io.importers import csv, hdf5, json, mcap, minari, npz, parquet, torch
from astra_data.io.mapping import ImportMapping, read_mapping
from astra_data.io.recording import (
    VALUE_BYTES,
    ZARR,
    Block,
    Source,
    bounded,
    find_sources,
    foreign,
    identities,
    is_archive,
    joined,
    named_apart,
    other_files,
    refuse_dataset,
)

FORMATS: Mapping[str, ModuleType] = {
    "csv": csv,
    "hdf5": hdf5,
    "json": json,
    "mcap": mcap,
    "minari": minari,
    "npz": npz,
    "parquet": parquet,
    "torch": torch,
}
IN_ARCHIVES = ("csv", "json")
"""Formats that are read sequentially, so that they can be read inside archives."""
_NAMED = 50
"""Files with one and the same fault that are named."""


def import_dataset(
    recordings: Sequence[Path],
    mapping: Path | None = None,
    *,
    out: Path | None = None,
    file_format: str | None = None,
    name: str | None = None,
    fps: int | None = None,
    task: str | None = None,
    max_bytes: int | None = None,
    skip_bad: bool = False,
) -> ImportReport:
    """Turn recordings into one dataset; at most a block of rows and an episode are in memory at once.

    Of our own exports the sums are verified; without a mapping, all that was exported comes back.

    Args:
        recordings: files, folders or archives of one format.
        mapping: the file that says which fields become which columns; D4RL, robomimic, d3rlpy, Minari
            and PACE need none.
        out: the dataset's folder, by default its place at home.
        file_format: one of `FORMATS`, by default inferred from the recordings' names.
        name: of the dataset; like `fps` and `task`, it overrides the mapping.
        fps: steps per second.
        task: what the episodes do.
        max_bytes: the most bytes of values that are taken from the recordings, eight a value; by default 100
            times the size of the files, or 256 MiB if that is more.
        skip_bad: leave out files and episodes that cannot be imported, which the report and the dataset's
            description list; with a mapping only.

    Raises:
        BadInputError: a recording is malformed, unpacks to too much or does not fit the mapping; nothing is
            written.
        CorruptDatasetError: an export of ours was altered; nothing is written.
        RecipeError: the mapping has faults.
    """
    if not recordings:
        raise BadInputError("expected one recording or more to import, got none")
    began = time.perf_counter()
    options = only_given(name=name, fps=fps, task=task, format=file_format)
    settings = None
    if mapping is not None:
        read = read_mapping(mapping)
        settings = validated(read.model_dump() | options, ImportMapping, str(mapping))
    chosen = (settings.format if settings else file_format) or _common_format(recordings)
    if chosen not in FORMATS:
        raise BadInputError(f"no format '{chosen}'{did_you_mean(chosen, FORMATS)}")
    format_ = FORMATS[chosen]
    if settings:
        settings.refuse_timeless(chosen, str(mapping))
    sources = [source for recording in recordings for source in _sources(recording, chosen)]
    if settings and chosen == "csv" and settings.files:
        sources = joined(sources, settings.files)
    sources = named_apart(bounded(sources, max_bytes))
    strange = [str(source) for source in sources if not is_text(f"{source.path}/{source}")]
    if strange:
        raise BadInputError(f"{strange[0]!r}: expected a name in UTF-8; rename the file to import it")
    if settings and chosen == "mcap" and not settings.split.files:
        _refuse_parts(sources)
    if skip_bad and settings is None:
        raise BadInputError("--skip-bad needs a --mapping, which says what is missing")
    left_out: list[str] = []
    records = _records(sources, format_)
    if records and settings is None:
        if len(sources) > 1:
            raise BadInputError(
                f"{next(iter(records))} is an export of astra-data: import each export separately, then merge"
            )
        return _restored_export(sources[0], format_, records[sources[0]], options, out, began)
    for source, record in records.items():
        deque(_restored(source, format_, record), maxlen=0)  # verifies the sums
    taken = ""
    if settings is None:
        settings, taken = _standard(sources[0], chosen, options)
    cutter = Cutter(settings, skip_bad=skip_bad)
    cuts = episodes(sources, format_, settings, cutter, left_out if skip_bad else None)
    first = next(cuts, None)
    if first is None:
        if faults := left_out + cutter.tally.bad_episodes:
            raise BadInputError("\n".join(faults))
        refuse_rejected(cutter.tally, settings)
        why = _why_none(cutter.tally, settings)
        raise BadInputError(f"{', '.join(map(str, recordings))}: no episodes, {why} ({losses(cutter.tally)})")
    description = {
        "name": settings.name,
        "version": settings.version,
        "stage": "import",
        "config": settings.model_dump(exclude_defaults=True) | {"recordings": identities(sources)},
    }
    root = home_of(description) if out is None else out
    if root.exists():
        raised = f"raise `version` in the mapping (now {settings.version}), " if mapping else ""
        another = f"{raised}give another --name or an --out" if out is None else "give another --out"
        raise BadInputError(f"{root} exists already: {another}, or delete it")
    frames = count = 0
    origins: set[str] = set()
    with DatasetWriter(
        root, cutter.columns, fps=settings.fps, task=settings.task, description=description
    ) as writer:
        for count, (columns, metadata) in enumerate(chain([first], cuts), start=1):
            writer.add(Episode(count - 1, columns, metadata))
            origins.add(str(metadata["source"]))
            frames += len(columns[TRUNCATED])
        if not skip_bad:
            refuse_rejected(cutter.tally, settings)
        cutter.check()
        seconds = time.perf_counter() - began
        left_out += cutter.tally.bad_episodes
        writer.made = {"wall_seconds": seconds, **asdict(cutter.tally)}
        writer.made |= {"left_out": left_out} if left_out else {}
    names = [str(source) for source in sources]
    # Where episodes are parts of files, their origins are no files' names.
    are_files = settings.split.files and origins <= set(names)
    unused = tuple(name for name in names if are_files and name not in origins)
    unread = () if chosen == "minari" else other_files(recordings, _suffixes(format_))
    seconds = time.perf_counter() - began
    return ImportReport(root, count, frames, cutter.tally, seconds, unused, unread, tuple(left_out), taken)


def _refuse_parts(sources: Sequence[Source]) -> None:
    """Refuse to let the files of a folder continue one another where each is resampled by itself."""
    for recording, files in Counter(source.recording for source in sources).items():
        if files > 1:
            raise BadInputError(
                f"{recording}: split.files = false cannot join its {files} MCAP files, each of which is "
                "resampled separately: join them with `ros2 bag convert` or `mcap merge`, or leave out the "
                "key, so that an episode ends with each file"
            )


def _records(sources: Sequence[Source], format_: ModuleType) -> dict[Source, ExportRecord]:
    """Return the records of those `sources` that are our own exports."""
    records = {}
    for source in sources:
        with explained(source, format_):
            if record := read_record(format_, source):
                records[source] = record
    return records


def _restored(source: Source, format_: ModuleType, record: ExportRecord) -> Iterator[Episode]:
    with explained(source, format_):
        yield from restored(format_, source, record)


def _restored_export(
    source: Source,
    format_: ModuleType,
    record: ExportRecord,
    options: Mapping[str, Any],
    out: Path | None,
    began: float,
) -> ImportReport:
    """Write our own export back as it was."""
    recorded = _restored(source, format_, record)
    root, frames = write_restored(record, recorded, options, identities([source]), out)
    seconds = time.perf_counter() - began
    return ImportReport(root, len(record.lengths), frames, Tally(rows=frames), seconds)


def _common_format(recordings: Sequence[Path]) -> str:
    faults, formats = [], {}
    for recording in recordings:
        try:
            formats[recording] = _format_of(recording)
        except BadInputError as error:
            faults.append(str(error))
    if len(set(formats.values())) > 1:
        listed = ", ".join(f"{path} {name}" for path, name in formats.items())
        faults.append(f"expected recordings of one format, got {listed}")
    if faults:
        raise BadInputError("\n".join(faults))
    return next(iter(formats.values()))


def _format_of(recording: Path) -> str:
    refuse_dataset(recording)
    if minari.is_dataset(recording):
        return "minari"
    inside = [str(path) for path in files_below(recording)] if recording.is_dir() else []
    if any(name.endswith(ZARR) for name in inside):
        raise BadInputError(f"{recording}: {foreign(inside)}")
    names = [str(source) for source in find_sources(recording, [""])]
    for name, module in FORMATS.items():
        if any(file.lower().endswith(_suffixes(module)) for file in names):
            return name
    unknown = f"its format cannot be inferred from its name; pass --format {'|'.join(FORMATS)}"
    raise BadInputError(f"{recording}: {mcap.advice(names) or foreign(names) or unknown}")


def _suffixes(module: ModuleType) -> tuple[str, ...]:
    return tuple(getattr(module, "SUFFIXES", ()))


def log_suffixes(mapping: ImportMapping) -> tuple[str, ...]:
    """Return the endings of the names of logs that `mapping` may describe."""
    modules = FORMATS.values() if mapping.format is None else [FORMATS[mapping.format]]
    return tuple(suffix for module in modules for suffix in _suffixes(module))


def _sources(recording: Path, file_format: str) -> list[Source]:
    if file_format == "minari":
        if not minari.is_dataset(recording):
            raise BadInputError(f"{recording}: expected the folder of a Minari dataset, with data/ in it")
        return [Source(recording, None, recording)]
    if is_archive(recording) and file_format not in IN_ARCHIVES:
        raise BadInputError(f"{recording}: {file_format} cannot be read from an archive: unpack it")
    return find_sources(recording, _suffixes(FORMATS[file_format]))


def _standard(source: Source, file_format: str, options: Mapping[str, Any]) -> tuple[ImportMapping, str]:
    """Return the mapping of a file with standard fields, and what it takes as what."""
    module = FORMATS[file_format]
    if not hasattr(module, "layout"):
        written = ", which `astra-data new NAME --from LOGS` writes" if file_format == "csv" else ""
        raise BadInputError(
            f"{source}: {file_format} has no standard fields; pass --mapping FILE.toml{written}"
        )
    with explained(source, module):
        keys = module.layout(source) | options
    missing = [f"--{key}" for key in ("name", "fps") if key not in keys]
    if missing:
        raise BadInputError(f"{source}: pass {' and '.join(missing)}, or --mapping FILE.toml")
    remark = keys.pop("remark", "")
    settings = validated({"task": keys["name"]} | keys, ImportMapping, str(source))
    taken = [f"{name} from {', '.join(column.fields)}" for name, column in settings.columns.items()]
    return settings, "; ".join([*taken, *([remark] if remark else [])])


def _why_none(tally: Tally, settings: ImportMapping) -> str:
    """Return why recordings hold no episode: what cuts most of their rows, if anything does."""
    cuts = {reason: tally.split_points.get(reason, 0) for reason in ("gap", "back", "field")}
    reasons = {
        "gap": f"'{settings.time}' steps by over gap_s in {cuts['gap']} rows: correct time_scale or gap_s",
        "back": f"'{settings.time}' goes back in {cuts['back']} rows, first in {tally.back_first}: sort the "
        "rows by it",
        "field": f"'{settings.split.field}' changes in {cuts['field']} rows: sort by it, or write a file of "
        "each",
    }
    for reason, why in reasons.items():
        if 2 * cuts[reason] > tally.rows:
            return why
    return "and each needs two rows if logs have no next states"


def episodes(
    sources: Sequence[Source],
    module: ModuleType,
    mapping: ImportMapping,
    cutter: Cutter,
    left_out: list[str] | None = None,
) -> Iterator[Cut]:
    """Yield the episodes of `sources`, as the format's `module` reads them.

    Args:
        sources: the files.
        module: the importer of their format.
        mapping: says which fields become which columns.
        cutter: cuts their rows.
        left_out: what is wrong with files and episodes that are left out is added to it; without it, they are
            refused.

    Raises:
        BadInputError: a file cannot be read, or an episode does not fit into memory. The files after it that
            cannot either, as far as their beginnings tell, are listed with it.
    """
    recording = None
    size = 0
    try:
        for number, source in enumerate(sources):
            source = source if left_out is None else replace(source, faults=left_out)
            is_apart = mapping.split.files or source.recording != recording
            origin, row, is_bad, is_fed = "", 0, False, False
            try:
                for block in _unstacked(_blocks(source, module, mapping), mapping):
                    size += VALUE_BYTES * sum(values.size for values in block.values.values())
                    source.refuse_beyond(size)
                    recording = source.recording
                    row = row if block.origin == origin else 0
                    is_bad &= not block.starts
                    try:
                        yield from () if is_bad else cutter.feed(block, row, is_apart=is_apart)
                    except BadInputError as error:
                        if left_out is None:
                            raise
                        left_out.append(str(error))
                        is_bad = True
                        yield from cutter.abandon() if is_fed and not block.starts else ()
                    is_fed |= not is_bad
                    is_apart, origin, row = is_apart and is_bad, block.origin, row + len(block)
            except BadInputError as error:
                if left_out is None:
                    faults = _faults(error, sources[number:], module, mapping)
                    raise BadInputError("\n".join(_by_fault(faults))) from error
                left_out.append(str(error))
                yield from cutter.abandon() if is_fed else ()
        yield from cutter.finish()
    except MemoryError as error:
        raise BadInputError(
            f"an episode does not fit into memory ({in_short(error)}): cut it by [split] in the mapping"
        ) from error


@contextmanager
def explained(source: Source, module: ModuleType) -> Iterator[None]:
    """Turn any exception of the library that reads a file into one clear message."""
    try:
        yield
    except AstraDataError:
        raise
    except Exception as error:
        file_format = module.__name__.rpartition(".")[2]
        message = in_short(error) or type(error).__name__
        raise BadInputError(f"{source} cannot be read as {file_format}: {message}") from error


def refuse_rejected(tally: Tally, mapping: ImportMapping) -> None:
    """Raise BadInputError where rows have values that are not finite, which `mapping` refuses."""
    not_finite = tally.rejected_rows - tally.torn_rows
    if not_finite and mapping.not_finite == "refuse":
        raise BadInputError(
            f"{not_finite} of {tally.rows} rows have values that are not finite: {tally.faults}; set "
            'not_finite in the mapping to leave such rows out: "split" ends the episode there, "drop" goes '
            "on with the next row as if one step had passed; or --skip-bad to leave out such episodes"
        )


def _unstacked(blocks: Iterator[Block], mapping: ImportMapping) -> Iterator[Block]:
    """Yield `blocks`; where fields are (episodes, steps, ...), a block for each episode.

    Raises:
        BadInputError: fields may be so, and the mapping does not say whether they are.
    """
    row, origin = 0, ""
    for block in blocks:
        row, origin = (row if block.origin == origin else 0), block.origin
        shapes = [values.shape[1:] for values in map(np.asarray, block.values.values())]
        steps = shapes[0][0] if shapes[0] else 1
        may_be = steps > 1 and {shape[:1] for shape in shapes} == {(steps,)} and max(map(len, shapes)) > 1
        if not mapping.stacked:
            if may_be and mapping.stacked is None and (len(shapes) > 1 or len(block) < steps):
                raise BadInputError(
                    f"{origin}: all fields have {steps} rows in each of their rows, such as "
                    f"{next(iter(block.values))} of shape {(len(block), *shapes[0])}: set stacked = true in "
                    f"the mapping if these are the steps of {len(block)} episodes, else stacked = false"
                )
            yield block
            continue
        if not may_be:
            raise BadInputError(
                f"{origin}: stacked = true, but the fields' rows have the shapes "
                f"{', '.join(map(str, shapes))}; expected (steps, ...) with as many steps in each"
            )
        for episode in range(len(block)):
            values = {field: np.asarray(stack)[episode] for field, stack in block.values.items()}
            yield Block(values, f"{origin}/{row + episode}", starts=True, known=block.known)
        row += len(block)


def _faults(
    error: BadInputError, sources: Sequence[Source], module: ModuleType, mapping: ImportMapping
) -> dict[Source, str]:
    """Return what is wrong with the first of `sources`, and with others, as their beginnings tell."""
    faults = {sources[0]: str(error)}
    for source in sources[1:]:
        try:
            _check(source, module, mapping)
        except BadInputError as other:
            faults[source] = str(other)
    return faults


def _blocks(source: Source, module: ModuleType, mapping: ImportMapping) -> Iterator[Block]:
    with explained(source, module):
        yield from module.read(source, mapping)


def _check(source: Source, module: ModuleType, mapping: ImportMapping) -> None:
    """Raise BadInputError where the beginning of `source` tells that it cannot be read."""
    if not hasattr(module, "check"):
        next(_blocks(source, module, mapping), None)
        return
    with explained(source, module):
        module.check(source, mapping)


def _by_fault(faults: dict[Source, str]) -> list[str]:
    """Return a line for each fault, with the names of the files that have it."""
    names: dict[str, list[str]] = {}
    for source, fault in faults.items():
        begins = str(source) if fault.startswith(str(source)) else ""
        names.setdefault(fault.removeprefix(begins), []).append(begins)
    return [f"{first_few([name for name in of if name], _NAMED)}{fault}" for fault, of in names.items()]
