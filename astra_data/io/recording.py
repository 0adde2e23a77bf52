"""Recordings in other formats: their files, and the blocks of rows that importers read from them."""

import os
import re
import shlex
import tarfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath, PurePosixPath
from typing import IO, cast

from astra_data.core.config import MOST_KNOWN, did_you_mean
from astra_data.core.durable import file_digest, files_below
from astra_data.core.errors import BadInputError, in_short
from astra_data.core.naming import first_few, is_text
from astra_data.dataset.columns import Array
from astra_data.dataset.format import INFO_PATH
from astra_data.dataset.plain import read_object
from astra_data.io.mapping import ImportMapping

VALUE_BYTES = 8  # what a value is counted as, whatever its type
SMALL_BYTES = 2**28  # values of so many bytes are taken from recordings of any size
MOST_UNPACKED = 100  # logs of a robot are compressed by less; files made to fill a memory by more

ARCHIVES = (".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tar.xz")
IN_ARCHIVES = ("csv", "json")  # formats that are read sequentially, so that they can be read inside archives
ZARR = (".zgroup", ".zarray", ".zattrs", "zarr.json")
FOREIGN = {
    (".npy",): "a NumPy array without a name: save it beside others under names, numpy.savez('log.npz', "
    "state=..., action=...), and import that",
    (".db3", ".db3.zstd"): "a bag of ROS 2 in SQLite, expected MCAP: write `output_bags: [{uri: NEW, storage_id: "
    "mcap, all: true}]` to a file new.yaml, run `ros2 bag convert -i BAG -o new.yaml`, and import NEW",
    (".gz", ".bz2", ".xz", ".zst", ".zstd", ".zip", ".7z"): "compressed: unpack it (gunzip, bunzip2, unxz, "
    "unzstd, unzip)",
    (".bag",): "a bag of ROS 1: run `uvx --from rosbags rosbags-convert --src FILE --dst NEW --dst-storage "
    "mcap`, and import NEW with a mapping like recipes/imports/ros2_base.toml",
    (".ulg",): "a log of PX4: run `uvx --from pyulog ulog2csv FILE`, and import the folder of its CSVs, "
    'joined by time (fields such as "vehicle_odometry_0.csv:q[0]", time = "timestamp", time_scale = 1e-6)',
    ZARR: "Zarr: save its arrays by numpy.savez('log.npz', **{name: array[:] for name, array in "
    "zarr.open(FOLDER).arrays()}), and import that",
    (".pkl", ".pickle", ".joblib"): "a pickle, which is code and never run: load it where you trust it, and "
    "numpy.savez its arrays",
    (".xlsx", ".xls", ".ods"): "a spreadsheet: save it as CSV",
}  # endings of files that are not read, and what they are and what to do


@dataclass(frozen=True)
class Source:
    """One file of a recording."""

    path: Path  # the file, or the archive that holds it
    member: tarfile.TarInfo | None  # its entry in the archive
    recording: Path  # the file, folder or archive given by the user; its files follow one another
    most_bytes: int = SMALL_BYTES  # most bytes of values that are taken from it
    name: str = ""  # what it is called, by default by the last part of its path
    parts: Mapping[str, "Source"] = field(default_factory=dict, compare=False)
    """The files of a recording that are joined by time, by their names in the mapping."""
    faults: list[str] | None = field(default=None, compare=False)
    """What is wrong with episodes that cannot be read and are left out; None where they are refused."""

    def refuse_beyond(self, size: int) -> None:
        """Raise BadInputError if values of `size` bytes are too many to be taken."""
        if size > self.most_bytes:
            raise BadInputError(
                f"{self} holds values of {size} bytes or more, but at most {self.most_bytes} are accepted: "
                "robot logs do not compress that much. If you trust it, pass a larger --max-bytes."
            )

    @property
    def most_unpacked(self) -> int:
        """Most bytes that are unpacked, values or not."""
        return max(self.most_bytes, SMALL_BYTES, MOST_UNPACKED * self.path.stat().st_size)

    @contextmanager
    def tolerant(self) -> Iterator[None]:
        """Add what makes an episode unreadable to `faults`, if there are some, instead of raising it."""
        try:
            yield
        except BadInputError as error:
            if self.faults is None:
                raise
            self.faults.append(str(error))

    @property
    def place(self) -> Path:
        """Its path, in which an archive is a folder."""
        return self.path if self.member is None else self.path / self.member.name

    def __str__(self) -> str:
        return self.name or self.place.name

    @contextmanager
    def open(self) -> Iterator[IO[bytes]]:
        """Open the file for reading bytes, in an archive without unpacking it."""
        if self.member is None:
            with self.path.open("rb") as stream:
                yield stream
            return
        if self.member.size > self.most_unpacked:
            self.refuse_beyond(self.member.size)
        with tarfile.open(self.path) as archive:
            yield cast(IO[bytes], archive.extractfile(self.member))  # find_sources returns plain files


@dataclass(frozen=True, eq=False)
class Block:
    """Consecutive rows: those of a file, or of an episode of a format that has its own."""

    values: Mapping[str, Array]  # field to n rows, (n,) or (n, ...)
    origin: str  # the file and part of the file that they come from
    starts: bool = False  # whether an episode of the format itself begins with the first row
    torn: int = 0  # how many rows after the last one are cut off at the end of the file, 0 or 1
    notes: tuple[str, ...] = ()  # what the import's report tells of them, in a line each
    places: Mapping[int, str] = field(default_factory=dict)
    """Where the values of some rows were recorded, if the number of the row does not tell."""
    line: Callable[[int], int] | None = None  # of a row of the file by its number, where lines may be empty
    known: Collection[str] = ()  # the fields, or topics, that this part of the file has
    row: int = 0  # the number of the first row in that part

    def __len__(self) -> int:
        return len(next(iter(self.values.values())))

    def place(self, at: int) -> str:
        """Name row `at` of the block."""
        return self.places.get(at) or self.row_name(self.row + at)

    def row_name(self, number: int) -> str:
        """Name the row, or the cut off one after the last, that has a `number` in its part of the file."""
        return f"{self.origin} line {self.line(number)}" if self.line else f"{self.origin} row {number}"


def foreign(names: Sequence[str]) -> str:
    """Say what files of these names are and how to import what they hold; nothing where that is not known."""
    if any(".tfrecord" in name.lower() for name in names):
        advice = "by numpy.savez('0.npz', state=..., action=..., reward=...), then import the folder"
        return f"RLDS (TensorFlow Datasets): load it with tensorflow_datasets, and save each episode's steps {advice}"
    plain = [name for name in names if not is_archive(Path(name))]
    found = ((name, advice) for name in plain for ends, advice in FOREIGN.items() if name.lower().endswith(ends))
    return next((f"{PurePosixPath(name).name} is {advice}" for name, advice in found), "")


def format_of(recordings: Sequence[Path], suffixes: Mapping[str, Sequence[str]]) -> str:
    """Return the format of all `recordings`, by the `suffixes` of each, or raise BadInputError."""
    if not recordings:
        raise BadInputError("expected one recording or more to import, got none")
    faults, formats = [], {}
    for recording in recordings:
        try:
            formats[recording] = _format_of(recording, suffixes)
        except BadInputError as error:
            faults.append(str(error))
    if len(set(formats.values())) > 1:
        listed = ", ".join(f"{path} {name}" for path, name in formats.items())
        faults.append(f"expected recordings of one format, got {listed}")
    if faults:
        raise BadInputError("\n".join(faults))
    return next(iter(formats.values()))


def _format_of(recording: Path, suffixes: Mapping[str, Sequence[str]]) -> str:
    refuse_dataset(recording)
    if is_minari(recording):
        return "minari"
    if any(str(path).endswith(ZARR) for path in files_below(recording)):
        raise BadInputError(f"{recording}: {foreign(list(map(str, files_below(recording))))}")
    names = [str(source) for source in _found(recording, [""])]
    for name, endings in suffixes.items():
        if any(file.lower().endswith(tuple(endings)) for file in names):
            return name
    unknown = f"its format cannot be inferred from its name; pass --format {'|'.join(suffixes)}"
    raise BadInputError(f"{recording}: {foreign(names) or unknown}")


def is_minari(path: Path) -> bool:
    """Return whether `path` is the folder of a Minari dataset."""
    return (path / "data" / "metadata.json").is_file() or (path / "data" / "main_data.hdf5").is_file()


def find_sources(
    recordings: Sequence[Path],
    file_format: str,
    suffixes: Sequence[str],
    mapping: ImportMapping | None = None,
    max_bytes: int | None = None,
) -> list[Source]:
    """List the files of recordings in natural order (2 before 10), without hidden ones, named apart.

    Those in folders and archives end with `suffixes`; archives hold plain files inside of them. `mapping` says which
    are joined. By default, the `max_bytes` of values that are taken are in proportion to their sizes.
    """
    sources: list[Source] = []
    for recording in recordings:
        if file_format == "minari" and not is_minari(recording):
            raise BadInputError(f"{recording}: expected the folder of a Minari dataset, with data/ in it")
        if is_archive(recording) and file_format not in IN_ARCHIVES:
            raise BadInputError(f"{recording}: {file_format} cannot be read from an archive: unpack it")
        if not recording.name.lower().endswith(tuple(suffixes)) and (hint := foreign([recording.name])):
            raise BadInputError(f"{recording}: {hint}")
        found = [Source(recording, None, recording)] if file_format == "minari" else _found(recording, suffixes)
        if file_format == "mcap" and mapping and not mapping.split.files and len(found) > 1:
            raise BadInputError(
                f"{recording}: split.files = false cannot join its {len(found)} MCAP files, each of which is "
                "resampled separately: join them with `ros2 bag convert` or `mcap merge`, or leave out the "
                "key, so that an episode ends with each file"
            )
        sources += found
    once = dict[tuple[Path, str], int]()
    for at in sorted(range(len(sources)), key=lambda at: sources[at].path.is_symlink()):  # a file before links to it
        once.setdefault((sources[at].path.resolve(), member.name if (member := sources[at].member) else ""), at)
    sources = [sources[at] for at in sorted(once.values())]
    if file_format == "csv" and mapping and mapping.files:
        sources = _joined(sources, mapping.files)
    for source in sources:
        if not is_text(str(source.place)):
            raise BadInputError(f"{str(source)!r}: expected a name in UTF-8; rename the file to import it")
    most = max_bytes or max(SMALL_BYTES, MOST_UNPACKED * sum(file.stat().st_size for file in files_of(sources)))
    names = named((source.place, source.recording) for source in sources)
    return [replace(source, name=name, most_bytes=most) for source, name in zip(sources, names, strict=True)]


def _found(recording: Path, suffixes: Sequence[str]) -> list[Source]:
    if not recording.exists():
        raise BadInputError(f"{recording} does not exist")
    if not (recording.is_file() or recording.is_dir()):
        raise BadInputError(f"{recording} is a device or a pipe, expected a file or a folder")
    if not (recording.is_dir() or is_archive(recording)):
        return [Source(recording, None, recording)]
    sources = [source for source in _inside(recording) if str(source).lower().endswith(tuple(suffixes))]
    if not sources:
        endings = " or ".join(filter(None, suffixes))
        expected = f"files that end with {endings}" if endings else "files"
        hint = foreign([str(path) for path in files_below(recording)]) if recording.is_dir() else ""
        raise BadInputError(f"{recording}: {hint or f'expected {expected}, found none'}")
    return sorted(sources, key=lambda source: natural(str(source.place)))


def other_files(recordings: Sequence[Path], suffixes: Sequence[str]) -> tuple[str, ...]:
    """Name the files in folders and archives that `find_sources` leaves out by their endings, but texts for people."""
    beside = (*suffixes, ".toml", ".md")
    inside = [source for path in recordings if path.is_dir() or is_archive(path) for source in _inside(path)]
    others = [(one.place, one.recording) for one in inside if not str(one).lower().endswith(beside)]
    return tuple(sorted(named(pair for pair in others if not pair[0].name.lower().startswith("readme")), key=natural))


def refuse_dataset(place: Path) -> None:
    """Raise BadInputError if a folder is a dataset already, ours or one that LeRobot recorded."""
    info = read_object(place / INFO_PATH)
    if isinstance(info, dict) and "codebase_version" in info:
        advice = f"use it directly, as in `astra-data inspect {shlex.quote(str(place))}`, or as `data` in a recipe"
        raise BadInputError(f"{place} is a LeRobot dataset, not logs, and needs no import: {advice}")


def is_archive(path: Path) -> bool:
    """Return whether `path` has the name of an archive."""
    return path.name.lower().endswith(ARCHIVES)


def natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key that orders numbers in names by value."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", name)]


def refuse_broken_links(paths: Iterable[Path]) -> None:
    """Refuse those of `paths` that are links to nothing."""
    if broken := [str(path) for path in paths if path.is_symlink() and not path.exists()]:
        raise BadInputError(f"{first_few(broken, 3)}: a link to nothing: remove it, or restore what it leads to")


def _inside(recording: Path) -> list[Source]:
    """Return the files in a folder or an archive, without hidden ones."""
    if recording.is_dir():
        refuse_broken_links(path for path in recording.rglob("*") if _is_seen(path.relative_to(recording)))
        files = [path for path in files_below(recording) if _is_seen(path.relative_to(recording))]
        return [Source(path, None, recording) for path in files]
    members = [member for member in _members(recording) if _is_seen(PurePosixPath(member.name))]
    return [Source(recording, member, recording) for member in members]


def _is_seen(path: PurePath) -> bool:
    """Return whether no part of `path` is hidden; archives made on a Mac have a hidden file beside each."""
    return not any(part.startswith(".") or part == "__MACOSX" for part in path.parts)


def _members(archive: Path) -> list[tarfile.TarInfo]:
    """Return the files in an archive; of those of one name the last, which unpacking it leaves, too."""
    try:
        with tarfile.open(archive) as opened:
            members = list({member.name: member for member in opened if not member.isdir()}.values())
    except (tarfile.TarError, OSError, EOFError, ValueError, ArithmeticError) as error:
        raise BadInputError(f"{archive} cannot be read as an archive: {in_short(error)}") from error
    faults = [f"{m.name} is a link, a device or sparse" for m in members if not m.isfile() or m.issparse()]
    outside = [m.name for m in members if PurePosixPath(m.name).is_absolute() or ".." in PurePosixPath(m.name).parts]
    faults += [f"{name} lies outside of the archive" for name in outside]
    if faults:
        raise BadInputError(f"{archive}: expected plain files; {'; '.join(faults)}")
    return members


def row_count(origin: str, fields: Sequence[str], shapes: Mapping[str, tuple[int, ...]]) -> int:
    """Return how many rows `fields` have, of the `shapes` of every field in the file `origin`."""
    unused = [name for name in shapes if name not in fields]
    hints = {field: did_you_mean(field, unused) for field in fields if field not in shapes}
    faults = [f"no field '{field}'{hint}" for field, hint in hints.items() if hint.startswith(":")]
    if lost := [repr(field) for field, hint in hints.items() if not hint.startswith(":")]:
        some = "s" * (len(lost) > 1)
        faults.append(f"no field{some} {', '.join(lost)}; known: {first_few(list(shapes), MOST_KNOWN)}")
    found = {field: shapes[field] for field in fields if field in shapes}
    faults += [f"field '{field}' is a single value, expected rows" for field in found if not found[field]]
    lengths = {field: shape[0] for field, shape in found.items() if shape}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{field} {length}" for field, length in lengths.items())
        faults.append(f"fields differ in their number of rows ({listed})")
    if faults:
        raise BadInputError(f"{origin}: {'; '.join(faults)}")
    return next(iter(lengths.values()))


def _joined(sources: Sequence[Source], names: Sequence[str]) -> list[Source]:
    """Group files of one folder that are parts of one recording: names that end with `names` and else are the same."""
    groups: dict[tuple[str, str], dict[str, Source]] = {}
    for source in sources:
        folder, file = str(source.place.parent), source.place.name
        for name in sorted(names, key=len, reverse=True):
            if file.endswith(name):
                groups.setdefault((folder, file.removesuffix(name)), {})[name] = source
                break
    faults = [] if groups else [f"expected files whose names end with {', '.join(names)}, found none"]
    for (folder, prefix), found in groups.items():
        joined = f"which is joined with {', '.join(map(str, found.values()))}"
        faults += [f"{folder}/{prefix}{name} is missing, {joined}" for name in names if name not in found]
    if faults:
        raise BadInputError("; ".join(faults))
    return [replace(found[names[0]], parts=found) for found in groups.values()]


def files_of(sources: Sequence[Source]) -> dict[Path, Path]:
    """Return the files, each with the recording that it is of."""
    files: dict[Path, Path] = {}
    each = [part for source in sources for part in (source.parts.values() or [source])]
    for path, recording in dict.fromkeys((source.path, source.recording) for source in each):
        files |= dict.fromkeys(files_below(path) if path.is_dir() else [path], recording)
    return files


def named(files: Iterable[tuple[Path, Path]]) -> list[str]:
    """Name files, each given with its recording, by their paths within the folder that holds all of these."""
    files = list(files)
    folders = {each if each.is_dir() and each != place else each.parent for place, each in files}
    root = os.path.commonpath([folder.absolute() for folder in folders]) if folders else ""
    return [place.absolute().relative_to(root).as_posix() for place, _ in files]


def identities(sources: Sequence[Source]) -> list[dict[str, str]]:
    """Return name and sha256 of every file of the recordings."""
    files = files_of(sources)
    return [{"name": name, "sha256": file_digest(file)} for name, file in zip(named(files.items()), files, strict=True)]
