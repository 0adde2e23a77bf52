"""Read a dataset: whole columns as contiguous arrays, or one episode at a time."""

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from astra_data.core.arrays import Bools, Ints
from astra_data.core.errors import BadInputError, CorruptDatasetError, in_short, optional
from astra_data.core.naming import RECORD, first_few
from astra_data.dataset import description as described
from astra_data.dataset import format as layout
from astra_data.dataset import plain
from astra_data.dataset.cameras import Camera, clip_fault, decoded, read_cameras
from astra_data.dataset.columns import RESERVED, SUCCESS, Array, Column, Episode, Scalar
from astra_data.dataset.format import BLOCK_VALUES, read_blocks, rows_of, to_numpy
from astra_data.dataset.lerobot_recording import RecordedFiles, open_recording
from astra_data.dataset.statistics import ranges

if TYPE_CHECKING:
    import datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset


_SHOWN = 4  # datasets of a run
_LOCATION = ("length", "data/chunk_index", "data/file_index")


@dataclass(frozen=True, eq=False, repr=False)
class Dataset:
    """A finished dataset of E episodes and N steps; make one with `Dataset.open`.

    Example:
        >>> from astra_data import Dataset
        >>> data = Dataset.open("walks")
        >>> data.reference, len(data)
        ('walks@data-1.0.0', 12)
        >>> data.columns(["action"])["action"].shape  # (N, A)
        (240, 2)
    """

    root: Path
    info: dict[str, Any]  # meta/info.json
    description: dict[str, Any]  # meta/astra/dataset.json
    metadata: dict[str, list[Scalar | None]]  # key to one value per episode, None where one has none
    uids: Ints  # (E,)
    lengths: Ints  # steps of each episode, (E,)
    order: list[int]  # the permutation of episode indices whose prefixes are the nested subsets
    subset_seed: int
    task: str
    paths: list[Path]  # the data files in order
    file_starts: Ints  # first row of each file
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    recorded: RecordedFiles | None = None  # where LeRobot recorded it, how its rows are converted

    @cached_property
    def starts(self) -> Ints:
        """First row of each episode, (E,)."""
        return np.cumsum(self.lengths) - self.lengths

    @classmethod
    def open(cls, root: Path | str) -> "Dataset":
        """Open the dataset in folder `root`, ours or LeRobot's; `versions.open_dataset` also takes names.

        Raises:
            BadInputError: there is no dataset, or one of LeRobot without states or actions.
            CorruptDatasetError: it is incomplete or was altered; lists every fault.
        """
        root = Path(root)
        refuse_others(root)
        with explained(root):
            is_ours = (root / layout.OUR_FOLDER).is_dir() or not (root / layout.INFO_PATH).is_file()
            return cls(**(_read(root) if is_ours else open_recording(root)))

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """LeRobot's features: dtype, shape, names, and our units, frames and roles under "astra"."""
        return dict(self.info["features"])

    @property
    def schema(self) -> list[Column]:
        """The columns given to the writer."""
        return self.specs([name for name in self.features if name not in RESERVED])

    @property
    def reference(self) -> str:
        """Name and version, such as "antmaze-long-random-seed0@data-1.0.0"."""
        return described.full_name(self.description)

    @property
    def content_hash(self) -> str:
        """The sha256 over the values of all columns."""
        return str(self.description["content_hash"])

    @property
    def identity(self) -> dict[str, str]:
        """Name, version and hash, as the datasets made from this one list them among their parents."""
        return described.identity_of(self.description)

    def __len__(self) -> int:
        return len(self.lengths)

    def __repr__(self) -> str:
        columns = ", ".join([*(f"{c.name} ({c.size}) {c.dtype}" for c in self.schema), *self.cameras])
        return f"Dataset({self.reference}, {len(self)} episodes, {self.lengths.sum()} steps, {columns})"

    def columns(self, names: Sequence[str], episodes: Collection[int] | None = None) -> dict[str, Array]:
        """Return whole columns by name, contiguous (n, size), or (n,) where there is one value per step.

        The n steps are those of `episodes`, by default of all, given as indices; they come in the dataset's order.

        Raises:
            CorruptDatasetError: a file cannot be read, or values differ from their digests.
        """
        rows, row = int(self.lengths[self.selected(episodes)].sum()), 0
        out = {c.name: np.empty((rows, c.size) if c.size > 1 else rows, c.dtype) for c in self.specs(names)}
        for block in self.blocks([*out], episodes):
            end = row + len(next(iter(block.values())))
            for name, values in block.items():
                out[name][row:end] = values
            row = end
        return out

    def blocks(self, names: Sequence[str], episodes: Collection[int] | None = None) -> Iterator[dict[str, Array]]:
        """Yield the values of the columns `names` in blocks of whole episodes; memory stays bounded."""
        for block, _ in self._verified(self.specs(names), self.selected(episodes)):
            yield block

    def selected(self, episodes: Collection[int] | None) -> Ints:
        """Return the episode indices `episodes`, by default all, in the dataset's order."""
        if episodes is None:
            return np.arange(len(self))
        given = np.array(list(episodes))
        if len(given) and given.dtype.kind not in "iu":
            raise BadInputError(f"{self.reference}: expected indices of episodes, such as np.flatnonzero of a mask")
        chosen, counts = np.unique(given.astype(np.int64), return_counts=True)
        outside = chosen[(chosen < 0) | (chosen >= len(self))]
        faults = [f"has no episode {episode}, expected 0 to {len(self) - 1}" for episode in outside]
        faults += [f"episode {episode} is listed twice" for episode in chosen[counts > 1]]
        faults += [] if len(chosen) else ["no episodes are listed"]
        if faults:
            raise BadInputError(f"{self.reference}: {'; '.join(faults)}.")
        return chosen

    def episodes(
        self, names: Sequence[str] | None = None, episodes: Collection[int] | None = None
    ) -> Iterator[Episode]:
        """Yield `episodes` in order with the columns `names`, by default `schema`; memory stays bounded."""
        specs = self.schema if names is None else self.specs(names)
        for block, indices in self._verified(specs, self.selected(episodes)):
            for episode, columns in self._split(block, indices):
                known = {key: value for key, values in self.metadata.items() if (value := values[episode]) is not None}
                clips = {name: camera.clips[episode] for name, camera in self.cameras.items()}
                yield Episode(int(self.uids[episode]), columns, known, clips)

    def pictures(self, camera: str, episode: int) -> NDArray[Any]:
        """Return the decoded pictures of an episode, by index: (T, H, W, 3) uint8, or (T, H, W) uint16 of depths."""
        return decoded(self.camera(camera).clips[self.selected([episode])[0]])

    def camera(self, name: str) -> Camera:
        """Return the camera `name`."""
        if name not in self.cameras:
            raise BadInputError(f"{self.reference} has no camera {name!r}; it has {', '.join(self.cameras) or 'none'}")
        return self.cameras[name]

    def successes(self) -> list[bool | None] | None:
        """Return whether each episode succeeded, by metadata or next.success; None where or if it is unknown."""
        stored = self.metadata.get("success", [None])
        known = [None if value is None or isinstance(value, str) else bool(value) for value in stored]
        if None in known and SUCCESS in self.features:
            return [bool(episode.columns[SUCCESS].any()) for episode in self.episodes([SUCCESS])]
        return None if set(known) == {None} else known

    @cached_property
    def recordings(self) -> Ints:
        """The number of the recording that each episode is, or is a copy or a part of, (E,), from 0 on."""
        sources, numbers = self.metadata.get("source_episode", [None] * len(self)), dict[Scalar, int]()
        of = {uid: uid if source is None else source for uid, source in zip(self.uids.tolist(), sources, strict=True)}
        # A copy may be of a part, as `trim` makes them.
        return np.array([numbers.setdefault(of.get(source, source), len(numbers)) for source in of.values()])

    @cached_property
    def held_out(self) -> Bools:
        """Which episodes are marked as held out, (E,); none where nothing is marked."""
        return np.array(self.metadata.get("held_out", [False] * len(self)), dtype=bool)

    def subset(self, count: int, seed: int | None = None) -> list[int]:
        """Return `count` episode indices; smaller subsets are prefixes of larger ones.

        Copies of a recording, as `augment` makes them, follow each other. The order is that of `seed`, by default the
        stored one.
        """
        if not 1 <= count <= len(self):
            raise BadInputError(f"{self.reference}: a subset of {count} episodes, expected 1 to {len(self)}.")
        position, order = {int(uid): index for index, uid in enumerate(self.uids)}, self.order
        if seed is not None:
            order = [position[uid] for uid in described.permutation(position, seed)]
        rank = {recording: place for place, recording in reversed([*enumerate(self.recordings[order].tolist())])}
        return sorted(order, key=lambda index: rank[int(self.recordings[index])])[:count]

    def statistics(self) -> dict[str, dict[str, Any]]:
        """Return meta/stats.json, column to statistic to values; of a recording, without quantiles.

        As lerobot's, its quantiles are estimates, from those of the episodes.
        """
        return self._statistics

    @cached_property
    def _statistics(self) -> dict[str, dict[str, Any]]:
        if self.recorded is not None:  # for which all values are read
            return ranges(self.blocks([column.name for column in self.schema]))
        found = plain.read_object(self.root / layout.STATS_PATH)
        if isinstance(found, str):
            raise CorruptDatasetError(f"{self.root}: {layout.STATS_PATH} {found}; astra-data repair rebuilds it")
        return found

    def verify(self) -> list[str]:
        """Read every value again, LeRobot's own columns included; return what was altered, if anything."""
        try:
            blocks = read_values(self, self.specs(list(self.features)), self.selected(None))
            faults = [fault for block, indices in blocks for fault in self.alterations(block, indices)]
            clips = (clip for camera in self.cameras.values() for clip in camera.clips.values())
            return faults + [fault for clip in clips if (fault := clip_fault(clip))]
        except CorruptDatasetError as error:
            return [str(error)]

    def require_whole(self) -> None:
        """Verify, for what states something of all values and pictures; raise CorruptDatasetError at a fault."""
        with explained(self.root):
            for fault in self.verify():
                raise CorruptDatasetError(fault)

    def to_huggingface(self) -> "datasets.Dataset":
        """Return the rows as a `datasets.Dataset` in memory, once all values are verified."""
        if self.recorded is not None:
            raise BadInputError(f"{self.root} holds other rows: first `astra-data subset {self.root} --percent 100`")
        self.require_whole()
        table = pa.concat_tables(map(pq.read_table, plain.data_files(self.root)))
        rows: datasets.Dataset = optional("datasets").Dataset(table)
        return rows

    def to_lerobot(self, **options: Any) -> "LeRobotDataset":
        """Return a `LeRobotDataset` of the same files, once all values are verified.

        It takes `options` such as `delta_timestamps`; lerobot keeps a copy of the rows in its cache.
        """
        self.require_whole()
        library, name = optional("lerobot.datasets.lerobot_dataset"), self.description["name"]
        opened: LeRobotDataset = library.LeRobotDataset(f"local/{name}", root=self.root, **options)
        return opened

    @cached_property
    def digests(self) -> described.Digests:
        """Those of the values as they were written, or as they were when a recording was opened."""
        return self.recorded.digests if self.recorded else described.read_digests(self.root, self.features)

    def _verified(self, columns: Sequence[Column], chosen: Ints) -> Iterator[tuple[dict[str, Array], Ints]]:
        """Yield blocks of whole episodes and their indices; the first one with altered values raises."""
        with explained(self.root):
            for block, indices in read_values(self, columns, chosen):
                for fault in self.alterations(block, indices):
                    raise CorruptDatasetError(fault)
                yield block, indices

    def _split(self, block: Mapping[str, Array], indices: Ints) -> Iterator[tuple[int, dict[str, Array]]]:
        """Yield the episodes `indices`, of which `block` has the values, and the values of each."""
        first = 0
        for episode in indices.tolist():
            last = first + int(self.lengths[episode])
            yield episode, {name: values[first:last] for name, values in block.items()}
            first = last

    def alterations(self, block: Mapping[str, Array], indices: Ints) -> Iterator[str]:
        """Yield a sentence for each episode of a block that has other values than were written."""
        for episode, values in self._split(block, indices):
            start = int(self.starts[episode])
            file = int(np.searchsorted(self.file_starts, start, side="right")) - 1
            row = start - int(self.file_starts[file])
            if fault := described.alteration(values, episode, self.digests, self.paths[file], row):
                yield fault

    def specs(self, names: Sequence[str]) -> list[Column]:
        """Return the columns `names`."""
        if isinstance(names, str):
            raise BadInputError(f"expected a list of columns, got the text '{names}': write ['{names}']")
        names = [*names]  # which may come one by one
        if unknown := [f"{name}" for name in names if name not in self.features]:
            seen = " (of a camera's pictures `astra-data features` makes one)" if {*unknown} & {*self.cameras} else ""
            has = f"it has {', '.join(self.features)}."
            raise BadInputError(f"{self.reference} has no column {', '.join(unknown)}{seen}; {has}")
        return [Column.from_feature(name, self.features[name]) for name in names]


def _read(root: Path) -> dict[str, Any]:
    """Return the fields of `Dataset` of our dataset in folder `root`, and read the footers of its data files."""
    description = described.read_description(root)
    if altered := described.altered_files(root, description):
        faults = (f"{path} {'was altered' if (root / path).exists() else 'missing'}" for path in altered)
        raise CorruptDatasetError("; ".join(faults))
    try:
        return _parsed(root, description)
    except (BadInputError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise CorruptDatasetError(f"its metadata are not those of a dataset ({in_short(error)})") from error


def _parsed(root: Path, description: dict[str, Any]) -> dict[str, Any]:
    """Read what is sealed, and therefore as the writer wrote it, unless somebody forged it."""
    info, subsets = (json.loads((root / path).read_bytes()) for path in (layout.INFO_PATH, layout.SUBSETS_PATH))
    if not plain.is_data_path(info["data_path"]):
        raise BadInputError(f"expected a path inside the dataset's folder, got {info['data_path']!r}")
    cameras = read_cameras(root, info)
    info["features"] = {name: it for name, it in info["features"].items() if name not in cameras}
    columns = [Column.from_feature(name, feature) for name, feature in info["features"].items()]
    tables = pa.concat_tables(read_blocks(plain.episodes_files(root), _LOCATION))
    lengths, chunks, files = (to_numpy(tables.column(name), 1, "int64") for name in _LOCATION)
    metadata = pa.concat_tables(read_blocks([root / layout.METADATA_PATH])).to_pydict()
    del metadata["length"]
    uids = metadata.pop("episode_uid")
    places, place = np.unique(np.column_stack([chunks, files]), axis=0, return_inverse=True)
    rows = {
        root / info["data_path"].format(chunk_index=chunk, file_index=file): int(count)
        for (chunk, file), count in zip(places.tolist(), np.bincount(place.ravel(), lengths), strict=True)
    }
    faults = [f"{name}: {camera.fault}" for name, camera in cameras.items() if camera.fault]
    others = [path.relative_to(root) for path in plain.data_files(root) if path not in rows]
    faults += [f"{path} does not belong to it" for path in others]
    for path, expected in rows.items():
        name, footer = path.relative_to(root), plain.read_footer(path)
        if isinstance(footer, str):
            faults.append(f"{name} {footer}")
            continue
        faults += [f"{name} has {footer[0]} rows, expected {expected}"] if footer[0] != expected else []
        faults += [f"{name} {fault}" for fault in plain.schema_faults(footer[1], columns)]
    tasks = plain.read_tasks(root)
    if isinstance(tasks, str) or 0 not in tasks:
        faults.append(f"{layout.TASKS_PATH} {tasks if isinstance(tasks, str) else 'has no task 0'}")
    if faults:
        raise CorruptDatasetError("; ".join(faults))
    position = {uid: episode for episode, uid in enumerate(uids)}
    return dict(
        root=root,
        info=info,
        description=description,
        metadata=metadata,
        uids=np.array(uids, dtype=np.int64),
        lengths=lengths,
        order=[position[uid] for uid in subsets["uids"]],
        subset_seed=int(subsets["seed"]),
        task=tasks[0],
        paths=list(rows),
        file_starts=np.cumsum([0, *rows.values()])[:-1],
        cameras=cameras,
    )


def read_values(dataset: Dataset, columns: Sequence[Column], episodes: Ints) -> Iterator[tuple[dict[str, Array], Ints]]:
    """Yield `columns` of `episodes`, ascending indices, in blocks of whole episodes, and the indices of each."""
    if not columns:
        return
    if dataset.recorded is not None:
        yield from _converted(dataset, columns, episodes)
        return
    wanted = rows_of(episodes, dataset.starts, dataset.lengths, int(dataset.lengths.sum()))
    ends = np.cumsum(dataset.lengths[episodes])
    rest: dict[str, Array] = {}
    row = first = 0
    most = max(1, BLOCK_VALUES // sum(column.size for column in columns))
    for table in read_blocks(dataset.paths, [column.name for column in columns], wanted, most):
        block = {c.name: to_numpy(table.column(c.name), c.size, c.dtype) for c in columns}
        rest = {name: np.concatenate([rest[name], block[name]]) for name in block} if rest else block
        rows = len(rest[columns[0].name])
        last = int(np.searchsorted(ends, row + rows, side="right"))
        cut = int(ends[last - 1]) - row if last > first else 0
        if cut:
            yield {name: values[:cut] for name, values in rest.items()}, episodes[first:last]
        rest = {name: values[cut:] for name, values in rest.items()} if cut < rows else {}
        row, first = row + cut, last
    if rest or first < len(episodes):
        raise CorruptDatasetError("the data files have other rows than when the dataset was opened")


def _converted(dataset: Dataset, columns: Sequence[Column], episodes: Ints) -> Iterator[tuple[dict[str, Array], Ints]]:
    """Yield what `read_values` does of a recording of LeRobot, an episode at a time."""
    assert dataset.recorded is not None
    recorded, rows = dataset.recorded, dataset.recorded.rows
    lengths = dataset.lengths + rows.dropped
    wanted = rows_of(episodes, recorded.first_rows, lengths, recorded.total_rows)
    stored = list(rows.stored.values())
    tables = read_blocks(dataset.paths, list(rows.stored), wanted)
    found = (run for run in plain.runs(dataset.root / "data", tables, stored) if len(run) > rows.dropped)
    for position, (episode, run) in enumerate(zip_longest(episodes.tolist(), found)):
        if run is None or episode is None or len(run) != lengths[episode]:
            raise CorruptDatasetError("its files were altered while they were read")
        place = (episode, int(dataset.starts[episode]), int(dataset.uids[episode]))
        yield rows.values(columns, run, *place), episodes[position : position + 1]


def refuse_others(root: Path) -> None:
    """Raise BadInputError where `root` holds no dataset, versions of one, or one of another format."""
    refuse_folders(root)
    fault = format_fault(root)
    if not fault and not (root / "meta").is_dir():
        advice = "check the path (`astra-data list` shows where names are) or run the stage that writes it."
        fault = f"{root}: found no dataset; {advice}"
        if logs := sorted(path.name for path in root.glob("*.[cC][sS][vV]")):
            advice = "make them a dataset with `astra-data import` and a mapping, which `astra-data new` writes"
            fault = f"{root} contains logs ({logs[0]} and so on): {advice}"
    if fault:
        raise BadInputError(fault)


def format_fault(root: Path) -> str | None:
    """Return a sentence if the dataset in `root` is LeRobot's and of another format than ours."""
    info = plain.read_object(root / layout.INFO_PATH)
    version = info.get("codebase_version") if isinstance(info, dict) else layout.CODEBASE_VERSION
    if version == layout.CODEBASE_VERSION or (root / layout.OUR_FOLDER).is_dir():
        return None
    found = f"{root} has LeRobot's format {version}, expected {layout.CODEBASE_VERSION}"
    if not plain.is_format_2(root):
        return f"{found}: convert it with a version of lerobot that reads both"
    return f"{found}: convert it with lerobot's convert_dataset_v21_to_v30, or astra-data repair {root} --out DIR"


def refuse_folders(root: Path) -> None:
    """Raise BadInputError where `root` holds versions of a dataset, or is the folder of a run; name its datasets."""
    if versions := sorted(path.name for path in root.glob("data-*.*.*") if (path / layout.INFO_PATH).is_file()):
        raise BadInputError(f"{root} contains versions of a dataset: name one of {', '.join(versions)}.")

    if not (root / RECORD).is_file() or (root / "meta").is_dir():
        return
    places = ("*/seed_*", "*/percent_*/seed_*")
    found = sorted(info.parents[1] for place in places for info in root.glob(f"{place}/{layout.INFO_PATH}"))
    held = f"its datasets are {first_few(found, _SHOWN)}" if found else "it has no datasets yet"
    raise BadInputError(f"{root} is a run; {held}")


@contextmanager
def explained(root: Path) -> Iterator[None]:
    """Say of a CorruptDatasetError, or of missing metadata, which dataset it is and what can be done."""
    try:
        yield
    except (CorruptDatasetError, KeyError) as error:
        fault = f"{error} is missing in its metadata" if isinstance(error, KeyError) else error
        repair = f"`astra-data repair {root} --out FOLDER`, with `--like ORIGINAL` if LeRobot's tools edited it."
        advice = f"Restore it from a copy, run the stage that wrote it again, or recover its intact episodes: {repair}"
        raise CorruptDatasetError(f"{root} is incomplete or was altered: {fault}. {advice}") from error
