"""Import recordings in other formats as datasets.

A recording is what a user names: a file, a folder or an archive. Its files are sources. An importer reads a
source in blocks of rows, whose fields a mapping turns into columns; the cutter cuts them into episodes.
"""

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from astra_data.core.config import did_you_mean, only_given, validated
from astra_data.core.errors import AstraDataError, BadInputError, in_short
from astra_data.core.naming import first_few
from astra_data.dataset.columns import TRUNCATED, Episode
from astra_data.dataset.inspection import Endings
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import home_of
from astra_data.dataset.writer import DatasetWriter
from astra_data.io.cutting import Cut, Cutter, Tally
from astra_data.io.importers import csv, hdf5, json, mcap, minari, npz, parquet, torch
from astra_data.io.mapping import ImportMapping, read_mapping
from astra_data.io.recording import VALUE_BYTES, Block, Source, find_sources, format_of, identities, other_files

if TYPE_CHECKING:
    import datasets

_MODULES = (csv, hdf5, json, mcap, minari, npz, parquet, torch)
FORMATS: Mapping[str, ModuleType] = {module.__name__.rpartition(".")[2]: module for module in _MODULES}
SUFFIXES = {name: getattr(module, "SUFFIXES", ()) for name, module in FORMATS.items()}
"""The endings of the names of each format's files; a Minari dataset is a folder."""
_NAMED = 50  # files with one and the same fault that are named
_LISTED = 8  # files, fields, and lines on rates, that are listed


@dataclass(frozen=True)
class ImportReport:
    """Result of an import."""

    root: Path
    episodes: int
    frames: int
    tally: Tally
    wall_seconds: float
    unused: tuple[str, ...] = ()  # files of which no episode was made; `unread`: of other endings than the format's
    unread: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()  # what is wrong with each file that was left out
    taken: str = ""  # which fields became which columns, where no mapping says so

    def __str__(self) -> str:
        tally = self.tally
        points = ", ".join(f"{reason} {count}" for reason, count in tally.split_points.items()) or "none"
        notes = [f"{first_few(files, 2)}: {note}" for note, files in tally.topics.items()] + tally.notes
        lost = []
        if tally.last_terminated:
            lost.append(f"{tally.last_terminated} of them terminated: the step before takes over how, and the reward")
        if tally.last_reward:
            lost.append(f"with the others a reward of {tally.last_reward:g} in sum")
        rejected = f"rejected rows: {tally.rejected_rows}" + (f", {tally.faults}" if tally.not_finite else "")
        if tally.torn_rows:
            rejected += f"; cut off at the end of their files: {tally.torn_rows}, the first is {tally.torn_first}"
        last = f"last rows without a next state: {tally.last_rows} dropped" + (f" ({', '.join(lost)})" if lost else "")
        last += f"; rows of episodes that were too short: {tally.short_rows}"
        if tally.rows_after_end:
            last += f"; terminated rows after the end, dropped: {tally.rows_after_end}"
        made = f"{self.root}: {self.episodes} episodes, {self.frames} frames from {tally.rows} rows"
        lines = {
            f"{made} in {self.wall_seconds:.1f} s": True,
            f"taken without a mapping: {self.taken}": self.taken,
            f"fields left out: {first_few(tally.unused_fields, _LISTED)}": tally.unused_fields,
            f"split points: {points}": True,
            f"episodes end: {tally.endings}": tally.endings != Endings(),
            f"rate: {tally.clock}": tally.clock,
            "\n".join(notes[:_LISTED]): notes,
            f"and {len(notes) - _LISTED} more lines on rates": len(notes) > _LISTED,
            f"time stands still in {tally.still_rows} rows, first in {tally.still_first}: expected one row "
            "at a time; they are of several robots, or written twice": tally.still_rows,
            f"files without an episode: {first_few(self.unused, _LISTED)}": self.unused,
            f"files of other endings, not read: {first_few(self.unread, _LISTED)}": self.unread,
            f"files that cannot be imported, left out: {len(self.left_out)}": self.left_out,
            "\n".join(f"  {fault}" for fault in self.left_out): self.left_out,
            rejected: True,
            last: True,
        }
        return "\n".join(line for line, is_shown in lines.items() if is_shown)


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
    """Turn recordings into one dataset; at most the rows of one file are in memory at once.

    Recordings are files, folders or archives of one of `FORMATS`. The file `mapping` says which fields become which
    columns; D4RL, robomimic, d3rlpy, Minari and PACE need none. `name`, `fps` and `task` override it. At most
    `max_bytes` of values are taken, eight a value, by default 100 times the size of the files, or 256 MiB if that is
    more. With `skip_bad`, files and episodes that cannot be imported are left out, which the report lists.
    """
    began = time.perf_counter()
    options = only_given(name=name, fps=fps, task=task, format=file_format)
    settings = None
    if mapping is not None:
        settings = validated(read_mapping(mapping).model_dump() | options, ImportMapping, str(mapping))
    elif skip_bad:
        raise BadInputError("--skip-bad needs a --mapping, which says what is missing")
    chosen = (settings.format if settings else file_format) or format_of(recordings, SUFFIXES)
    if chosen not in FORMATS:
        raise BadInputError(f"no format '{chosen}'{did_you_mean(chosen, FORMATS)}")
    if settings:
        settings.refuse_timeless(chosen, str(mapping))
    sources = find_sources(recordings, chosen, SUFFIXES[chosen], settings, max_bytes)
    taken = ""
    if settings is None:
        settings, taken = _standard(sources[0], chosen, options)
    left_out: list[str] | None = [] if skip_bad else None
    cutter = Cutter(settings, skip_bad=skip_bad)
    cuts = _episodes(sources, FORMATS[chosen], cutter, left_out)
    first = next(cuts, None)
    if first is None:
        tally = cutter.tally
        if bad := [*(left_out or ()), *tally.bad_episodes]:
            raise BadInputError("\n".join(bad))
        _refuse_rejected(cutter)
        faults = f" ({tally.faults})" if tally.not_finite else ""
        lost = f"last ones without a next state {tally.last_rows}, in episodes that were too short {tally.short_rows}"
        counts = f"(rows {tally.rows}, rejected {tally.rejected_rows}{faults}, {lost})"
        raise BadInputError(f"{', '.join(map(str, recordings))}: no episodes, {_why_none(cutter)} {counts}")
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
    with DatasetWriter(root, cutter.columns, fps=settings.fps, task=settings.task, description=description) as writer:
        for count, (columns, metadata) in enumerate(chain([first], cuts), start=1):
            writer.add(Episode(count - 1, columns, metadata))
            origins.add(str(metadata["source"]))
            frames += len(columns[TRUNCATED])
        if not skip_bad:
            _refuse_rejected(cutter)
        cutter.check()
        bad = [*(left_out or ()), *cutter.tally.bad_episodes]
        writer.made = {"wall_seconds": time.perf_counter() - began, **asdict(cutter.tally)}
        writer.made |= {"left_out": bad} if bad else {}
    names = [str(source) for source in sources]
    # Where episodes are parts of files, their origins are no files' names.
    are_files = settings.split.files and origins <= set(names)
    unused = tuple(name for name in names if are_files and name not in origins)
    unread = () if chosen == "minari" else other_files(recordings, SUFFIXES[chosen])
    seconds = time.perf_counter() - began
    return ImportReport(root, count, frames, cutter.tally, seconds, unused, unread, tuple(bad), taken)


def from_huggingface(table: "datasets.Dataset", mapping: Path | str, *, out: Path | None = None) -> Dataset:
    """Import the rows of a `datasets.Dataset`, in the order of time, as `import` does those of a Parquet file.

    `[split] field = "episode_index"` of the mapping cuts them.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rows.parquet"
        table.to_parquet(path)
        return Dataset.open(import_dataset([path], Path(mapping), out=out).root)


def _standard(source: Source, file_format: str, options: Mapping[str, Any]) -> tuple[ImportMapping, str]:
    """Return the mapping of a file with standard fields, and what it takes as what."""
    module = FORMATS[file_format]
    if not hasattr(module, "layout"):
        written = ", which `astra-data new NAME --from LOGS` writes" if file_format == "csv" else ""
        raise BadInputError(f"{source}: {file_format} has no standard fields; pass --mapping FILE.toml{written}")
    with explained(source, module):
        keys = module.layout(source) | options
    if missing := [f"--{key}" for key in ("name", "fps") if key not in keys]:
        raise BadInputError(f"{source}: pass {' and '.join(missing)}, or --mapping FILE.toml")
    remark = [keys.pop("remark")] if "remark" in keys else []
    mapping = validated({"task": keys["name"]} | keys, ImportMapping, str(source))
    return mapping, "; ".join([f"{name} from {', '.join(c.fields)}" for name, c in mapping.columns.items()] + remark)


def _why_none(cutter: Cutter) -> str:
    """Return why recordings hold no episode: what cuts most of their rows, if anything does."""
    tally, mapping, cuts = cutter.tally, cutter.mapping, Counter(cutter.tally.split_points)
    reasons = {
        "gap": f"'{mapping.time}' steps by over gap_s in {cuts['gap']} rows: correct time_scale or gap_s",
        "back": f"'{mapping.time}' goes back in {cuts['back']} rows, first in {tally.back_first}: sort the rows by it",
        "field": f"'{mapping.split.field}' changes in {cuts['field']} rows: sort by it, or write a file of each",
    }
    found = [why for reason, why in reasons.items() if 2 * cuts[reason] > tally.rows]
    return found[0] if found else "and each needs two rows if logs have no next states"


def _episodes(sources: Sequence[Source], module: ModuleType, cutter: Cutter, faults: list[str] | None) -> Iterator[Cut]:
    """Yield the episodes of `sources`, as the format's `module` reads them and the `cutter` cuts their rows.

    What is wrong with files and episodes is added to `faults`, and they are left out; without it, they are refused.
    """
    mapping, recording, size, lost = cutter.mapping, None, 0, 0
    try:
        for number, source in enumerate(sources):
            source = replace(source, faults=faults)
            is_apart = mapping.split.files or source.recording != recording or lost < len(faults or ())
            lost = len(faults or ())
            try:
                for block in _blocks(source, module, mapping):
                    size += VALUE_BYTES * sum(values.size for values in block.values.values())
                    source.refuse_beyond(size)
                    recording = source.recording
                    with source.tolerant():
                        yield from cutter.feed(block, is_apart=is_apart)
                        is_apart = False
            except BadInputError as error:
                if faults is None:
                    raise BadInputError(_all_faults(error, sources[number:], module, mapping)) from error
                faults.append(str(error))
        yield from cutter.cut()
    except MemoryError as error:
        why = f"an episode does not fit into memory ({in_short(error)})"
        raise BadInputError(f"{why}: cut it by [split] in the mapping") from error


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


def _refuse_rejected(cutter: Cutter) -> None:
    """Raise BadInputError where rows have values that are not finite, which the mapping refuses."""
    tally = cutter.tally
    not_finite = tally.rejected_rows - tally.torn_rows
    if not_finite and cutter.mapping.not_finite == "refuse":
        raise BadInputError(
            f"{not_finite} of {tally.rows} rows have values that are not finite: {tally.faults}; set "
            'not_finite in the mapping to leave such rows out: "split" ends the episode there, "drop" goes '
            "on with the next row as if one step had passed; or --skip-bad to leave out such episodes"
        )


def _blocks(source: Source, module: ModuleType, mapping: ImportMapping) -> Iterator[Block]:
    """Yield the blocks of a file; where fields are (episodes, steps, ...), one for each episode."""
    with explained(source, module):
        for block in module.read(source, mapping):
            origin, shapes = block.origin, {name: np.shape(values)[1:] for name, values in block.values.items()}
            several = [shape for shape in shapes.values() if shape]
            steps = several[0][0] if several else 1
            may_be = steps > 1 and {shape[:1] for shape in several} == {(steps,)}
            are_all = len(several) == len(shapes)
            if mapping.stacked and not (may_be and are_all):
                listed = ", ".join(map(str, shapes.values()))
                fault = f"stacked = true, but the fields' rows have the shapes {listed}"
                raise BadInputError(f"{origin}: {fault}; expected (steps, ...) with as many steps in each")
            if mapping.stacked is None and may_be:
                has_matrix, is_short = max(map(len, several)) > 1, len(block) < steps
                is_sure = has_matrix and are_all
                # With single numbers among them, or without a matrix, only too few rows give them away.
                is_odd = is_short and not block.starts and (has_matrix or are_all)
                if (is_sure and is_short) or (len(shapes) > 1 and (is_sure or is_odd)):
                    name, shape = next((name, shape) for name, shape in shapes.items() if shape)
                    raise BadInputError(
                        f"{origin}: {'all' if are_all else 'many'} fields have {steps} rows in each of their "
                        f"rows, such as {name} of shape {(len(block), *shape)}: set stacked = true in the "
                        f"mapping if these are the steps of {len(block)} episodes, else stacked = false"
                    )
            for episode in range(len(block)) if mapping.stacked else ():
                values = {field: np.asarray(stack)[episode] for field, stack in block.values.items()}
                yield Block(values, f"{origin}/{episode}", starts=True, known=block.known)
            if not mapping.stacked:
                yield block


def _all_faults(error: BadInputError, sources: Sequence[Source], module: ModuleType, mapping: ImportMapping) -> str:
    """Return a line for each fault of the first of `sources` and of the beginnings of others, with its files."""
    names: dict[str, list[str]] = {}
    for source in sources:
        fault = str(error) if source is sources[0] else ""
        try:
            with explained(source, module):
                if not fault and hasattr(module, "check"):
                    module.check(source, mapping)
                elif not fault:
                    next(_blocks(source, module, mapping), None)
        except BadInputError as another:
            fault = str(another)
        if fault:
            of = names.setdefault(fault.removeprefix(str(source)), [])
            of += [str(source)] if fault.startswith(str(source)) else []
    return "\n".join(f"{first_few(of, _NAMED)}{fault}" for fault, of in names.items())
