"""Write a dataset: episodes stream into a hidden folder, which becomes the dataset once it is complete."""

import json
import shutil
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.core import durable
from astra_data.core.errors import AstraDataError, BadInputError, CorruptDatasetError, DiskError, in_short, unmet
from astra_data.core.naming import is_text
from astra_data.dataset import columns as names
from astra_data.dataset import description as described
from astra_data.dataset import format as layout
from astra_data.dataset.cameras import ClipWriter, images
from astra_data.dataset.columns import Column, Episode, Scalar
from astra_data.dataset.format import to_arrow, to_numpy
from astra_data.dataset.plain import flag_faults, open_end_faults, read_object
from astra_data.dataset.reader import Dataset
from astra_data.dataset.statistics import EpisodeRows, episode_statistics, pooled

_METADATA_TYPES = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}


class DatasetWriter:
    """Writes one dataset atomically.

    Leaving the block verifies and commits; after an exception or a kill at any moment, `root` does not exist.

    Attributes:
        made: further keys of meta/astra/dataset.json, such as how long it took; set before leaving the block.
        policy: file of the policy that acted, to be copied into the dataset; set before leaving the block.

    Example:
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from astra_data import Column, Dataset, DatasetWriter, Episode
        >>> columns = [Column("observation.state", size=3), Column("action", size=2)]
        >>> description = {"name": "cart", "stage": "collect"}
        >>> recording = {"fps": 20, "task": "drive", "description": description}
        >>> with DatasetWriter(Path("cart"), columns, **recording) as writer:
        ...     state, action = np.zeros((5, 3), np.float32), np.zeros((5, 2), np.float32)
        ...     writer.add(Episode(0, {"observation.state": state, "action": action}))
        >>> len(Dataset.open("cart"))
        1
    """

    def __init__(
        self,
        root: Path,
        columns: Sequence[Column],
        *,
        fps: int,
        task: str,
        description: Mapping[str, Any],
        subset_seed: int = 0,
        cameras: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        """Prepare to write; entering the block starts.

        Args:
            root: the dataset's folder; must not exist yet.
            columns: those of every episode, without `columns.RESERVED`.
            fps: steps per second.
            task: of all episodes, a sentence or a name.
            description: see `complete_description`.
            subset_seed: of the permutation whose prefixes are the nested subsets.
            cameras: LeRobot's features of the cameras of every episode.
        """
        given = [column.name for column in columns]
        reserved = [name for name in given if name in names.RESERVED]
        checks = {
            **{f"column {name} is given twice": given.count(name) == 1 for name in sorted(given)},
            **{f"column {name}: is filled in by the writer, leave it out": False for name in reserved},
            "no columns": bool(given),
            f"fps {fps!r}, expected a positive int": type(fps) is int and fps >= 1,
            f"task {task!r}, expected text of valid characters": is_text(task),
        }
        around = [folder for folder in root.absolute().parents if (folder / layout.INFO_PATH).is_file()]
        checks |= {f"expected a folder outside of the dataset {folder}": False for folder in around}
        if faults := unmet(checks):
            raise BadInputError(f"Dataset {root}: {'; '.join(faults)}.")
        self.root = root
        self._columns = {column.name: column for column in columns}
        self._stored = layout.stored_columns(columns)
        self._cameras = dict(cameras or {})
        images_of = [name for name, feature in self._cameras.items() if feature["dtype"] == "image"]
        self._schema = layout.data_schema(self._stored, images_of)
        self._most_rows = 1 if images_of else layout.GROUP_ROWS  # of several episodes
        self._group: list[pa.Table] = []  # the episodes of the next row group
        self._group_rows = 0
        self._fps, self._task, self._subset_seed = fps, task, subset_seed
        self._description = described.complete_description(description)
        self.made: dict[str, Any] = {}
        self.policy: Path | None = None
        self._hash = described.ContentHash()
        self._digests = {column.name: array("Q") for column in self._stored}
        self._frames = 0
        self._lengths: dict[int, int] = {}
        self._metadata: list[Mapping[str, Scalar]] = []
        self._admission = Admission(columns, self._cameras)
        self._exit = ExitStack()
        self._is_open = False
        self._clips: dict[str, ClipWriter] = {}

    @property
    def content_hash(self) -> str:
        """The hash of all episodes added so far."""
        return self._hash.hexdigest()

    def __enter__(self) -> "DatasetWriter":
        with ExitStack() as stack:
            self._folder = stack.enter_context(durable.atomic_folder(self.root))
            encodings = layout.data_encodings(self._stored)
            # As LeRobot's; zstd is smaller, and slower.
            self._data = layout.RotatingWriter(self._folder, layout.DATA_PATH, self._schema, encodings, "snappy")
            stack.callback(self._data.abandon)
            self._rows = EpisodeRows(self._folder, self._stored, self._task, self._cameras)
            for name, feature in self._cameras.items():
                if feature["dtype"] == "video":
                    self._clips[name] = ClipWriter(self._folder, name, self._fps)
                    stack.callback(self._clips[name].close)
            stack.callback(self._rows.file.abandon)
            self._exit = stack.pop_all()
        self._is_open = True
        return self

    def __exit__(self, *raised: Any) -> None:
        """Commit, or after an error remove the hidden folder."""
        self._is_open = False
        if raised[1] is not None:
            self._exit.__exit__(*raised)
            return
        with self._exit:
            self._finish()

    def add(self, episode: Episode) -> None:
        """Append `episode`; a refused one changes nothing.

        Raises:
            BadInputError: it does not fit the columns or the earlier episodes; lists every fault.
        """
        if not self._is_open:
            raise BadInputError(f"{self.root}: add episodes inside `with DatasetWriter(...) as writer:`.")
        self._admission.check(episode)
        length = len(episode)
        pictures, held = dict[str, Any](), dict[str, pa.Array]()
        try:
            for name, clip in episode.cameras.items() if self._cameras else ():
                pictures |= {f"stats/{name}/{key}": value for key, value in clip.statistics.items()}
                if name not in self._clips:
                    held[name] = pa.array(images(clip), layout.IMAGE)
                    continue
                span = self._clips[name].add(clip)
                place = (*divmod(span.file, layout.CHUNK_SIZE), span.from_s, span.to_s)
                pictures |= {f"videos/{name}/{key}": x for key, x in zip(layout.VIDEO_PLACE, place, strict=True)}
        except CorruptDatasetError as error:
            advice = "`astra-data repair DATASET --out FOLDER` keeps the other episodes"
            raise CorruptDatasetError(f"{error}: {advice}") from None
        values = {name: episode.columns[name] for name in self._columns} | layout.reserved_values(
            length, uid=episode.uid, episode=len(self._lengths), start=self._frames, fps=self._fps
        )
        values[names.TIMESTAMP] = values[names.TIMESTAMP].astype(np.float32)
        held |= {name: to_arrow(np.array(column)) for name, column in values.items()}
        self._admission.keep(episode)
        if self._group_rows + length > self._most_rows:
            self._write_group()
        chunk, file = self._data.locate()
        self._group.append(pa.table(held, schema=self._schema))
        self._group_rows += length
        for name, column in values.items():
            self._hash.update(name, column)
            self._digests[name].append(described.digest_of(column))
        self._rows.append(length, chunk, file, episode_statistics(values.values()), pictures)
        self._frames += length
        self._lengths[episode.uid] = length
        self._metadata.append(episode.metadata)

    def _write_group(self) -> None:
        """Write the episodes that are held as a row group; images are those of one."""
        if self._group:
            self._data.write(pa.concat_tables(self._group).combine_chunks())
            self._group, self._group_rows = [], 0

    def _finish(self) -> None:
        """Close the data files, write all other files and verify."""
        self._write_group()
        self._data.close()
        self._rows.close()
        for clips in self._clips.values():
            clips.close()
        if not self._lengths:
            raise BadInputError(f"{self.root}: no episodes were added; a dataset needs at least one.")
        episodes, uids = len(self._lengths), list(self._lengths)
        info = layout.dataset_info(self._stored, self._cameras, fps=self._fps, episodes=episodes, frames=self._frames)
        order = described.permutation(uids, self._subset_seed)
        self._write_json(layout.INFO_PATH, info)
        stats = self._rows.statistics()
        for name in self._cameras:
            known = [
                {key: one.get(f"stats/{name}/{key}") for key in layout.STORED_STATISTICS} for one in self._rows.pictures
            ]
            stats |= {name: found} if (found := pooled(known)) else {}
        self._write_json(layout.STATS_PATH, stats)
        self._write_json(layout.SUBSETS_PATH, {"seed": self._subset_seed, "uids": order})
        pq.write_table(layout.tasks_table(self._task), self._folder / layout.TASKS_PATH)
        metadata = {"episode_uid": pa.array(uids), "length": pa.array(list(self._lengths.values()))}
        for key, kind_ in sorted(self._admission.metadata_types.items()):
            metadata[key] = pa.array([row.get(key) for row in self._metadata], _METADATA_TYPES[kind_])
        pq.write_table(pa.table(metadata), self._folder / layout.METADATA_PATH)
        described.write_digests(self._folder, self._digests)
        description = self._description | self.made | {"content_hash": self.content_hash}
        if videos := sorted((self._folder / "videos").glob("*/*/*.mp4")):
            digests = {path.relative_to(self._folder).as_posix(): durable.file_digest(path) for path in videos}
            description |= {"videos": digests}
        self._write_json(layout.DATASET_PATH, described.sealed(self._folder, description))
        if self.policy:
            shutil.copyfile(self.policy, self._folder / layout.POLICY_PATH)
        if faults := Dataset.open(self._folder).verify():
            raise CorruptDatasetError(f"{self.root} was not written: {'; '.join(faults)}. Check the disk.")

    def _write_json(self, path: str, content: Mapping[str, Any]) -> None:
        target = self._folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(json.dumps(content, indent=4, ensure_ascii=False), encoding="utf-8")


class Admission:
    """Checks each new episode against the dataset's columns and against the episodes before it."""

    def __init__(self, columns: Sequence[Column], cameras: Iterable[str] = ()) -> None:
        self._columns = {column.name: column for column in columns}
        self._cameras = set(cameras)
        self._uids: set[int] = set()
        self.metadata_types: dict[str, type] = {}  # of each metadata key seen so far

    def check(self, episode: Episode) -> None:
        """Refuse `episode` with a BadInputError that lists every fault, if it has any."""
        if not isinstance(episode, Episode):
            kind = type(episode).__name__
            raise BadInputError(f"expected an Episode, made with Episode(uid, columns), got a {kind}")
        faults = [f"{name}: missing" for name in self._columns if name not in episode.columns]
        if self._cameras and (differing := self._cameras ^ episode.cameras.keys()):
            faults.append(f"cameras: expected {', '.join(sorted(self._cameras))}, differing {', '.join(differing)}")
        lengths = {name: clip.count for name, clip in episode.cameras.items() if clip.count != len(episode)}
        faults += [f"{name}: {count} pictures for {len(episode)} steps" for name, count in lengths.items()]
        for name, values in episode.columns.items():
            column = self._columns.get(name)
            faults += column.faults(values) if column else [f"{name}: unknown column"]
        for key, value in episode.metadata.items():
            found, known = type(value), self.metadata_types.get(key, type(value))
            if found is not known:
                faults.append(f"metadata {key}: {found.__name__}, earlier episodes have {known.__name__}")
            if key in layout.METADATA_KEYS:
                faults.append(f"metadata {key}: is filled in by the writer, leave it out")
        flags = {name: values for name, values in episode.columns.items() if values.dtype == bool}
        faults += [*flag_faults(flags), *open_end_faults(flags)]
        if episode.uid in self._uids:
            faults.append("an earlier episode has the same uid")
        if faults:
            raise BadInputError(f"Episode {episode.uid}: {'; '.join(faults)}.")

    def keep(self, episode: Episode) -> None:
        """Let those that follow be checked against `episode`, too."""
        self._uids.add(episode.uid)
        self.metadata_types |= {key: type(value) for key, value in episode.metadata.items()}


_SETTINGS = "plan.json"
_WRITTEN = ".written"  # the content hash of the dataset that the staged episodes become


class StagedWriter:
    """Writes a dataset whose episodes must not be lost, such as those of a robot.

    An episode is safe when `add` returns. Leaving the block writes the dataset; after an exception or a kill
    the episodes stay staged, and a writer with `resume` continues with them.

    Attributes:
        staged, lengths: metadata and steps of the staged episodes, by their position in the dataset.
        made, policy: as in `DatasetWriter`.
        folder: of the staged episodes, and of what else the recording needs to resume.

    Example:
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from astra_data import Column, Dataset, Episode, StagedWriter
        >>> columns = [Column("action", size=2)]
        >>> recording = {"fps": 20, "task": "drive", "description": {"name": "log", "stage": "collect"}}
        >>> with StagedWriter(Path("log"), columns, **recording, resume=True) as writer:
        ...     writer.add(Episode(len(writer.staged), {"action": np.zeros((5, 2), np.float32)}))
        >>> len(Dataset.open("log"))
        1
    """

    def __init__(
        self,
        root: Path,
        columns: Sequence[Column],
        *,
        fps: int,
        task: str,
        description: Mapping[str, Any],
        subset_seed: int = 0,
        resume: bool = False,
    ) -> None:
        """Prepare to record as `DatasetWriter` does; with `resume`, continue what was interrupted."""
        settings = {"fps": fps, "task": task, "subset_seed": subset_seed}
        self._writer = DatasetWriter(root, columns, **settings, description=description)  # type: ignore[arg-type]
        self.root, self.folder = root, root.parent / f".{root.name}.staged"
        self.made: dict[str, Any] = {}
        self.policy: Path | None = None
        self.staged: dict[int, Mapping[str, Scalar]] = {}
        self.lengths: dict[int, int] = {}
        self._columns, self._schema = list(columns), layout.data_schema(columns)
        features = {column.name: column.feature() for column in columns}
        self._settings = json.loads(json.dumps({"columns": features, "description": dict(description), **settings}))
        self._resume, self._is_open = resume, False
        self._admission, self._exit = Admission(columns), ExitStack()

    def __enter__(self) -> "StagedWriter":
        if self._holds_work() and not self._resume and not self.root.exists():
            advice = f"resume it (--resume), or delete {self.folder} to start again."
            raise BadInputError(f"{self.root}: an interrupted recording left {self._left()}; {advice}")
        with durable.writing(self.folder), ExitStack() as stack:
            stack.callback(durable.remove_empty, durable.make_folder(self.folder))
            durable.sweep(self.root)
            if not stack.enter_context(durable.held(self.folder)):
                raise BadInputError(f"{self.root} is being recorded right now; wait or choose another folder.")
            if self.root.exists():
                if self._holds_work() and not self._is_written():
                    fault = f"{self.root} exists already and is another dataset than the interrupted recording"
                    left = f"which left {self._left()} in {self.folder}: move one of the two away."
                    raise BadInputError(f"{fault}, {left}")
                durable.discard(self.folder, self.root)  # a kill came between the dataset and this
                durable.refuse_existing(self.root)
            self._agree_on_the_settings()
            for path in self._paths():
                episode = load_staged(path, self._columns)
                try:
                    self._admission.check(episode)
                except BadInputError as error:
                    raise BadInputError(f"{path}: {error} Delete it and resume the recording.") from error
                self._admission.keep(episode)
                self.staged[int(path.stem)], self.lengths[int(path.stem)] = episode.metadata, len(episode)
            self._exit = stack.pop_all()
        self._is_open = True
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """Write the dataset and remove the staged episodes; after an error, leave them to be resumed."""
        self._is_open = False
        with self._exit:
            is_written = False
            try:
                if error is None:
                    self._writer.made, self._writer.policy = self.made, self.policy
                    with self._keeping(), self._writer:
                        for position in sorted(self.staged):
                            self._writer.add(load_staged(self._path(position), self._columns))
                        durable.write_file(self.folder / _WRITTEN, self._writer.content_hash)
                    is_written = True
            finally:
                with suppress(OSError):  # what stays is recognized by the next call
                    if is_written or not self._holds_work():
                        durable.discard(self.folder, self.root)

    @contextmanager
    def _keeping(self) -> Iterator[None]:
        """Say how many episodes are safe if the disk fails."""
        try:
            yield
        except DiskError as error:
            safe = f"{len(self.staged)} episodes are safe in {self.folder}"
            how = "a recipe goes on with them by itself, the command for a task with --resume."
            raise DiskError(f"{error} {safe}: {how}") from error

    def add(self, episode: Episode, position: int | None = None) -> None:
        """Stage `episode` at `position`, by default after the last; a refused one changes nothing.

        Raises:
            BadInputError: it does not fit the columns, or the position is taken.
            DiskError: it cannot be written; it may be added again.
        """
        if not self._is_open:
            raise BadInputError(f"{self.root}: add episodes inside `with StagedWriter(...) as writer:`.")
        place = max(self.staged, default=-1) + 1 if position is None else position
        if place in self.staged:
            raise BadInputError(f"Episode {episode.uid}: there is an episode {place} already.")
        self._admission.check(episode)
        path = self._path(place)
        partial = path.with_suffix(".partial")
        with self._keeping(), durable.writing(path):
            write_staged(partial, episode, self._schema)
            durable.sync(partial)
            durable.move(partial, path)
        self._admission.keep(episode)
        self.staged[place], self.lengths[place] = episode.metadata, len(episode)

    def drop(self, position: int) -> None:
        """Leave out the staged episode at `position`."""
        with durable.writing(self._path(position)):
            self._path(position).unlink()
        del self.staged[position], self.lengths[position]

    def _holds_work(self) -> bool:
        """Return whether there is anything to resume beside the settings."""
        kept = (path for path in self.folder.glob("*") if not path.name.startswith("."))
        return any(path.name != _SETTINGS and path.suffix != ".partial" for path in kept)

    def _paths(self) -> list[Path]:
        return sorted(self.folder.glob("*.arrow"))

    def _left(self) -> str:
        return f"{len(self._paths())} episodes" if self._paths() else "an unfinished recording"

    def _is_written(self) -> bool:
        """Return whether the dataset at `root` is the one that the staged episodes became."""
        try:
            return (self.folder / _WRITTEN).read_text() == Dataset.open(self.root).content_hash
        except (OSError, AstraDataError):
            return False

    def _path(self, position: int) -> Path:
        return self.folder / f"{position:06d}.arrow"

    def _agree_on_the_settings(self) -> None:
        """Write the settings, or check that what was staged was made with the same."""
        before = read_object(self.folder / _SETTINGS)
        if isinstance(before, dict):
            if differing := ", ".join(key for key, *_ in described.changed_values(before, self._settings)):
                advice = f"resume it with the same settings, or delete {self.folder}."
                raise BadInputError(f"{self.root}: the interrupted recording differs in {differing}; {advice}")
        elif self._holds_work():
            advice = "so that nobody knows of which recording: delete the folder to start again."
            raise BadInputError(f"{self.folder} holds {self._left()}, but {_SETTINGS} {before}, {advice}")
        else:
            durable.write_file(self.folder / _SETTINGS, json.dumps(self._settings, indent=1, sort_keys=True))


def write_staged(path: Path, episode: Episode, schema: pa.Schema) -> None:
    """Write the columns of `schema`, with their digests, uid and metadata."""
    digests = {name: described.digest_of(episode.columns[name]) for name in schema.names}
    facts = {"uid": episode.uid, "metadata": dict(episode.metadata), "digests": digests}
    arrays = [to_arrow(episode.columns[name]) for name in schema.names]
    schema = schema.with_metadata({"episode": json.dumps(facts)})
    with path.open("wb") as sink, pa.ipc.new_file(sink, schema) as file:
        file.write_table(pa.Table.from_arrays(arrays, schema=schema))


def load_staged(path: Path, columns: Sequence[Column]) -> Episode:
    """Return the episode in the file at `path`."""
    advice = "delete it and resume the recording."
    try:
        if not path.is_file():
            raise OSError("it is no file")
        with pa.memory_map(str(path)) as source, pa.ipc.open_file(source) as file:
            table = file.read_all()
            facts = json.loads(table.schema.metadata[b"episode"])
            values = {c.name: to_numpy(table.column(c.name), c.size, c.dtype) for c in columns}
            uid, metadata, digests = facts["uid"], facts["metadata"], facts["digests"]
            altered = [name for name, digest in digests.items() if described.digest_of(values[name]) != digest]
    except (OSError, pa.ArrowException, AttributeError, KeyError, TypeError, ValueError) as error:
        raise CorruptDatasetError(f"{path} is no whole episode ({in_short(error)}); {advice}") from error
    if altered:
        raise CorruptDatasetError(f"{path} was altered in {', '.join(altered)}; {advice}")
    return Episode(uid, values, metadata)
