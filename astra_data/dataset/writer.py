"""Write a dataset: episodes stream into a hidden folder, which becomes the dataset once it is complete."""

import json
import shutil
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from astra_data.core.durable import atomic_folder, file_digest
from astra_data.core.errors import BadInputError, CorruptDatasetError, unmet
from astra_data.dataset import columns as names
from astra_data.dataset import format as layout
from astra_data.dataset.cameras import ClipWriter, images, pooled
from astra_data.dataset.columns import Column, Episode, Scalar
from astra_data.dataset.description import (
    ContentHash,
    complete_description,
    digest_of,
    permutation,
    sealed,
    write_digests,
)
from astra_data.dataset.format import METADATA_KEYS
from astra_data.dataset.parquet import RotatingWriter, to_arrow
from astra_data.dataset.plain import data_files, flag_faults, open_end_faults
from astra_data.dataset.reader import Dataset
from astra_data.dataset.statistics import EpisodeRows, episode_statistics, global_statistics

_METADATA_TYPES = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}
MOST_CHARACTERS = 2**20  # characters of a text in the metadata


class DatasetWriter:
    """Writes one dataset atomically.

        with DatasetWriter(root, columns, fps=20, task="reach the goal", description=...) as writer:
            writer.add(episode)

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
        compression: str = layout.COMPRESSIONS[0],
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
            compression: of the data files, one of `format.COMPRESSIONS`.
            cameras: LeRobot's features of the cameras of every episode.
        """
        given = [column.name for column in columns]
        reserved = [name for name in given if name in names.RESERVED]
        checks = {
            **{f"column {name} is given twice": given.count(name) == 1 for name in sorted(given)},
            **{f"column {name}: is filled in by the writer, leave it out": False for name in reserved},
            "no columns": bool(given),
            f"fps {fps!r}, expected a positive int": type(fps) is int and fps >= 1,
            f"compression {compression!r}, expected {' or '.join(layout.COMPRESSIONS)}": (
                compression in layout.COMPRESSIONS
            ),
            f"task {task!r}, expected text of valid characters": isinstance(task, str) and is_text(task),
        }
        if faults := unmet(checks):
            raise BadInputError(f"Dataset {root}: {'; '.join(faults)}.")
        self.root = root
        self._columns = {column.name: column for column in columns}
        self._stored = layout.stored_columns(columns)
        self._cameras = dict(cameras or {})
        images_of = [name for name, feature in self._cameras.items() if feature["dtype"] == "image"]
        self._schema = layout.data_schema(self._stored, images_of)
        self._fps, self._task, self._subset_seed, self._compression = fps, task, subset_seed, compression
        self._description = complete_description(description)
        self.made: dict[str, Any] = {}
        self.policy: Path | None = None
        self._hash = ContentHash()
        self._digests = {column.name: array("Q") for column in self._stored}
        self._frames = 0
        self._lengths: dict[int, int] = {}
        self._metadata: list[Mapping[str, Scalar]] = []
        self._admission = Admission(columns, self._cameras)
        self._exit = ExitStack()
        self._is_open = False

    @property
    def content_hash(self) -> str:
        """The hash of all episodes added so far."""
        return self._hash.hexdigest()

    def __enter__(self) -> "DatasetWriter":
        """Start the hidden folder."""
        with ExitStack() as stack:
            self._folder = stack.enter_context(atomic_folder(self.root))
            encodings = layout.data_encodings(self._stored)
            self._data = RotatingWriter(self._folder, layout.DATA_PATH, self._schema, encodings, self._compression)
            stack.callback(self._data.abandon)
            self._rows = EpisodeRows(self._folder, self._stored, self._task, self._cameras)
            self._clips = {
                name: ClipWriter(partial(self._video, name), self._fps)
                for name, feature in self._cameras.items()
                if feature["dtype"] == "video"
            }
            for clips in self._clips.values():
                stack.callback(clips.close)
            stack.callback(self._rows.abandon)
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
        self._admission.admit(episode)
        length = len(episode)
        pictures: dict[str, Any] = {}
        for name, clip in episode.cameras.items() if self._cameras else ():
            pictures |= {f"stats/{name}/{key}": value for key, value in clip.statistics.items()}
            if name in self._clips:
                span = self._clips[name].add(clip)
                place = (*divmod(span.file, layout.CHUNK_SIZE), span.from_s, span.to_s)
                pictures |= {f"videos/{name}/{key}": x for key, x in zip(layout.VIDEO_PLACE, place, strict=True)}
        values = {name: episode.columns[name] for name in self._columns} | layout.reserved_values(
            length, uid=episode.uid, episode=len(self._lengths), start=self._frames, fps=self._fps
        )
        values[names.TIMESTAMP] = values[names.TIMESTAMP].astype(np.float32)
        chunk, file = self._data.locate()
        arrays = [
            to_arrow(values[field.name], field.type)
            if field.name in values
            else pa.array(images(episode.cameras[field.name]), field.type)
            for field in self._schema
        ]
        self._data.write(pa.Table.from_arrays(arrays, schema=self._schema))
        for name, column in values.items():
            self._hash.update(name, column)
            self._digests[name].append(digest_of(column))
        self._rows.append(length, chunk, file, episode_statistics(values.values()), pictures)
        self._frames += length
        self._lengths[episode.uid] = length
        self._metadata.append(episode.metadata)

    def _finish(self) -> None:
        """Close the data files, write all other files and verify."""
        self._data.close()
        self._rows.close()
        for clips in self._clips.values():
            clips.close()
        if not self._lengths:
            raise BadInputError(f"{self.root}: no episodes were added; a dataset needs at least one.")
        episodes, uids = len(self._lengths), list(self._lengths)
        info = layout.dataset_info(self._stored, self._cameras, fps=self._fps, episodes=episodes, frames=self._frames)
        order = permutation(uids, self._subset_seed)
        self._write_json(layout.INFO_PATH, info)
        stats = global_statistics(self._stored, self._frames, data_files(self._folder))
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
        write_digests(self._folder, self._digests)
        description = self._description | self.made | {"content_hash": self.content_hash}
        if videos := sorted((self._folder / "videos").glob("*/*/*.mp4")):
            described = {path.relative_to(self._folder).as_posix(): file_digest(path) for path in videos}
            description |= {"videos": described}
        self._write_json(layout.DATASET_PATH, sealed(self._folder, description))
        if self.policy:
            shutil.copyfile(self.policy, self._folder / layout.POLICY_PATH)
        faults = Dataset.open(self._folder).verify()
        if faults:
            raise CorruptDatasetError(f"{self.root} was not written: {'; '.join(faults)}. Check the disk.")

    def _video(self, name: str, number: int) -> Path:
        chunk, file = divmod(number, layout.CHUNK_SIZE)
        return self._folder / layout.VIDEO_PATH.format(video_key=name, chunk_index=chunk, file_index=file)

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

    def admit(self, episode: Episode, *, keep: bool = True) -> None:
        """Accept `episode`, or refuse it with a BadInputError that lists every fault; `keep` it in mind."""
        if not isinstance(episode, Episode):
            kind = type(episode).__name__
            raise BadInputError(f"expected an Episode, made with Episode(uid, columns), got a {kind}")
        if faults := self._faults(episode):
            raise BadInputError(f"Episode {episode.uid}: {'; '.join(faults)}.")
        if keep:
            self._uids.add(episode.uid)
            self.metadata_types |= {key: type(value) for key, value in episode.metadata.items()}

    def _faults(self, episode: Episode) -> list[str]:
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
            if key in METADATA_KEYS:
                faults.append(f"metadata {key}: is filled in by the writer, leave it out")
            faults += _metadata_faults(key, value)
        flags = {name: values for name, values in episode.columns.items() if values.dtype == bool}
        faults += [*flag_faults(flags), *open_end_faults(flags)]
        if episode.uid in self._uids:
            faults.append("an earlier episode has the same uid")
        return faults


def is_text(value: str) -> bool:
    """Return whether `value` can be written as UTF-8; names of files that are not UTF-8 cannot."""
    return not any("\ud800" <= character <= "\udfff" for character in value)


def _metadata_faults(key: str, value: Scalar) -> Iterator[str]:
    """Yield why a value of the metadata cannot be stored."""
    if not isinstance(key, str) or not is_text(key) or not 0 < len(key) <= MOST_CHARACTERS:
        yield f"metadata {key!r:.80}: expected a text of valid characters as its name"
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        yield f"metadata {key}: an integer of more than 64 bits"
    elif isinstance(value, str) and len(value) > MOST_CHARACTERS:
        yield f"metadata {key}: {len(value):,} characters, expected at most {MOST_CHARACTERS:,}"
    elif isinstance(value, str) and not is_text(value):
        yield f"metadata {key}: {value!r:.80} has characters that are not valid Unicode"
