"""Import recordings in other formats as datasets.

A recording is what a user names: a file, a folder or an archive. Its files are sources. An importer reads a
source in blocks of rows, whose fields a mapping turns into columns; the cutter cuts them into episodes.
"""

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from astra_data.core.config import did_you_mean, only_given, validated
from astra_data.core.durable import files_below
from astra_data.core.errors import AstraDataError, BadInputError, in_short
from astra_data.core.naming import first_few
from astra_data.dataset.columns import TRUNCATED, Episode
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import home_of
from astra_data.dataset.writer import DatasetWriter, is_text
from astra_data.io.cutting import Cut, Cutter
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

if TYPE_CHECKING:
    import datasets

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
        RecipeError: the mapping has faults.
    """
    began = time.perf_counter()
    options = only_given(name=name, fps=fps, task=task, format=file_format)
    settings = None
    if mapping is not None:
        settings = validated(read_mapping(mapping).model_dump() | options, ImportMapping, str(mapping))
    elif skip_bad:
        raise BadInputError("--skip-bad needs a --mapping, which says what is missing")
    chosen = (settings.format if settings else file_format) or _common_format(recordings)
    if chosen not in FORMATS:
        raise BadInputError(f"no format '{chosen}'{did_you_mean(chosen, FORMATS)}")
    if settings:
        settings.refuse_timeless(chosen, str(mapping))
    sources = _sources(recordings, chosen, settings, max_bytes)
    taken = ""
    if settings is None:
        settings, taken = _standard(sources[0], chosen, options)
    left_out: list[str] | None = [] if skip_bad else None
    cutter = Cutter(settings, skip_bad=skip_bad)
    cuts = episodes(sources, FORMATS[chosen], settings, cutter, left_out)
    first = next(cuts, None)
    if first is None:
        if faults := [*(left_out or ()), *cutter.tally.bad_episodes]:
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
        bad = [*(left_out or ()), *cutter.tally.bad_episodes]
        writer.made = {"wall_seconds": time.perf_counter() - began, **asdict(cutter.tally)}
        writer.made |= {"left_out": bad} if bad else {}
    names = [str(source) for source in sources]
    # Where episodes are parts of files, their origins are no files' names.
    are_files = settings.split.files and origins <= set(names)
    unused = tuple(name for name in names if are_files and name not in origins)
    unread = () if chosen == "minari" else other_files(recordings, _suffixes(FORMATS[chosen]))
    seconds = time.perf_counter() - began
    return ImportReport(root, count, frames, cutter.tally, seconds, unused, unread, tuple(bad), taken)


def from_huggingface(table: "datasets.Dataset", mapping: Path | str, *, out: Path | None = None) -> Dataset:
    """Import the rows of a `datasets.Dataset`, as `import` does those of a Parquet file.

    Args:
        table: the rows, in the order of time; `[split] field = "episode_index"` of the mapping cuts them.
        mapping: the file that says which columns become which.
        out: the dataset's folder, by default its place at home.

    Raises:
        BadInputError: the rows do not fit the mapping; nothing is written.
        RecipeError: the mapping has faults.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rows.parquet"
        table.to_parquet(path)
        return Dataset.open(import_dataset([path], Path(mapping), out=out).root)


def _common_format(recordings: Sequence[Path]) -> str:
    """Return the format of all `recordings`, by their names."""
    if not recordings:
        raise BadInputError("expected one recording or more to import, got none")
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
    raise BadInputError(f"{recording}: {foreign(names) or unknown}")


def _suffixes(module: ModuleType) -> tuple[str, ...]:
    return tuple(getattr(module, "SUFFIXES", ()))


def _sources(
    recordings: Sequence[Path], file_format: str, mapping: ImportMapping | None, max_bytes: int | None
) -> list[Source]:
    """Return the files of `recordings`, named apart, and with the bytes that may be taken from them."""
    sources: list[Source] = []
    for recording in recordings:
        if file_format == "minari":
            if not minari.is_dataset(recording):
                raise BadInputError(f"{recording}: expected the folder of a Minari dataset, with data/ in it")
            found = [Source(recording, None, recording)]
        elif is_archive(recording) and file_format not in IN_ARCHIVES:
            raise BadInputError(f"{recording}: {file_format} cannot be read from an archive: unpack it")
        else:
            suffixes = _suffixes(FORMATS[file_format])
            if not recording.name.lower().endswith(suffixes) and (hint := foreign([recording.name])):
                raise BadInputError(f"{recording}: {hint}")
            found = find_sources(recording, suffixes)
        if file_format == "mcap" and mapping and not mapping.split.files and len(found) > 1:
            raise BadInputError(
                f"{recording}: split.files = false cannot join its {len(found)} MCAP files, each of which is "
                "resampled separately: join them with `ros2 bag convert` or `mcap merge`, or leave out the "
                "key, so that an episode ends with each file"
            )
        sources += found
    if file_format == "csv" and mapping and mapping.files:
        sources = joined(sources, mapping.files)
    for source in sources:
        if not is_text(f"{source.path}/{source}"):
            raise BadInputError(f"{str(source)!r}: expected a name in UTF-8; rename the file to import it")
    return named_apart(bounded(sources, max_bytes))


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
    mapping = validated({"task": keys["name"]} | keys, ImportMapping, str(source))
    taken = [f"{name} from {', '.join(column.fields)}" for name, column in mapping.columns.items()]
    return mapping, "; ".join([*taken, *([remark] if remark else [])])


def _why_none(tally: Tally, mapping: ImportMapping) -> str:
    """Return why recordings hold no episode: what cuts most of their rows, if anything does."""
    cuts = Counter(tally.split_points)
    reasons = {
        "gap": f"'{mapping.time}' steps by over gap_s in {cuts['gap']} rows: correct time_scale or gap_s",
        "back": f"'{mapping.time}' goes back in {cuts['back']} rows, first in {tally.back_first}: sort the "
        "rows by it",
        "field": f"'{mapping.split.field}' changes in {cuts['field']} rows: sort by it, or write a file of "
        "each",
    }
    found = [why for reason, why in reasons.items() if 2 * cuts[reason] > tally.rows]
    return found[0] if found else "and each needs two rows if logs have no next states"


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
            source = replace(source, faults=left_out)
            is_apart = mapping.split.files or source.recording != recording
            origin, row, is_bad, is_fed = "", 0, False, False
            try:
                for block in _blocks(source, module, mapping):
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
                    raise BadInputError(_all_faults(error, sources[number:], module, mapping)) from error
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


def _blocks(source: Source, module: ModuleType, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the blocks of a file; where fields are (episodes, steps, ...), one for each episode.

    Raises:
        BadInputError: it cannot be read; or fields may be so, and the mapping does not say whether they are.
    """
    row, origin = 0, ""
    with explained(source, module):
        for block in module.read(source, mapping):
            row, origin = (row if block.origin == origin else 0), block.origin
            shapes = [values.shape[1:] for values in map(np.asarray, block.values.values())]
            steps = shapes[0][0] if shapes[0] else 1
            may_be = steps > 1 and {shape[:1] for shape in shapes} == {(steps,)} and max(map(len, shapes)) > 1
            if mapping.stacked and not may_be:
                raise BadInputError(
                    f"{origin}: stacked = true, but the fields' rows have the shapes "
                    f"{', '.join(map(str, shapes))}; expected (steps, ...) with as many steps in each"
                )
            if may_be and mapping.stacked is None and (len(shapes) > 1 or len(block) < steps):
                raise BadInputError(
                    f"{origin}: all fields have {steps} rows in each of their rows, such as "
                    f"{next(iter(block.values))} of shape {(len(block), *shapes[0])}: set stacked = true in "
                    f"the mapping if these are the steps of {len(block)} episodes, else stacked = false"
                )
            if not mapping.stacked:
                yield block
                continue
            for episode in range(len(block)):
                values = {field: np.asarray(stack)[episode] for field, stack in block.values.items()}
                yield Block(values, f"{origin}/{row + episode}", starts=True, known=block.known)
            row += len(block)


def _all_faults(
    error: BadInputError, sources: Sequence[Source], module: ModuleType, mapping: ImportMapping
) -> str:
    """Return a line for each fault of the first of `sources` and the beginnings of others, with its files."""
    faults = {sources[0]: str(error)}
    for other in sources[1:]:
        try:
            with explained(other, module):
                if hasattr(module, "check"):
                    module.check(other, mapping)
                else:
                    next(_blocks(other, module, mapping), None)
        except BadInputError as another:
            faults[other] = str(another)
    names: dict[str, list[str]] = {}
    for at, fault in faults.items():
        begins = str(at) if fault.startswith(str(at)) else ""
        names.setdefault(fault.removeprefix(begins), []).append(begins)
    lines = [f"{first_few([name for name in of if name], _NAMED)}{fault}" for fault, of in names.items()]
    return "\n".join(lines)
