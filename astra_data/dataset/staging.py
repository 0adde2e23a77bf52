"""Record episodes that must not be lost: each is on disk at once, and a killed recording can be resumed.

<parent>/.<name>.staged/plan.json            the recording's settings
<parent>/.<name>.staged/000012.arrow         one finished episode
<parent>/.<name>.staged/...                  whatever else the recording needs to resume
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from astra_data.core import durable
from astra_data.core.errors import AstraDataError, BadInputError, CorruptDatasetError, DiskError, in_short
from astra_data.dataset import format as layout
from astra_data.dataset.columns import Column, Episode, Scalar
from astra_data.dataset.description import changed_values, digest_of
from astra_data.dataset.parquet import to_arrow, to_numpy
from astra_data.dataset.plain import read_object
from astra_data.dataset.reader import Dataset
from astra_data.dataset.writer import Admission, DatasetWriter

_SETTINGS = "plan.json"


class StagedWriter:
    """Writes a dataset whose episodes must not be lost, such as those of a robot.

        with StagedWriter(root, columns, fps=20, task="walk", description=..., resume=True) as writer:
            writer.add(episode)

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
        """Start or resume the recording."""
        if self._holds_work() and not self._resume and not self.root.exists():
            raise BadInputError(
                f"{self.root}: an interrupted recording left {self._left()}; "
                f"resume it (--resume), or delete {self.folder} to start again."
            )
        with durable.writing(self.folder), ExitStack() as stack:
            stack.callback(durable.remove_empty, durable.make_folder(self.folder))
            durable.sweep(self.root)
            if not stack.enter_context(durable.held(self.folder)):
                raise BadInputError(f"{self.root} is being recorded right now; wait or choose another folder.")
            if self.root.exists():
                if self._holds_work() and not self._is_written():
                    raise BadInputError(
                        f"{self.root} exists already and is another dataset than the interrupted recording, "
                        f"which left {self._left()} in {self.folder}: move one of the two away."
                    )
                durable.discard(self.folder, self.root)  # a kill came between the dataset and this
                durable.refuse_existing(self.root)
            self._agree_on_the_settings()
            for path in self._paths():
                episode = load_staged(path, self._columns)
                try:
                    self._admission.admit(episode)
                except BadInputError as error:
                    raise BadInputError(f"{path}: {error} Delete it and resume the recording.") from error
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
        self._admission.admit(episode, keep=False)
        path = self._path(place)
        partial = path.with_suffix(".partial")
        with self._keeping(), durable.writing(path):
            write_staged(partial, episode, self._schema)
            durable.sync(partial)
            durable.move(partial, path)
        self._admission.admit(episode)
        self.staged[place], self.lengths[place] = episode.metadata, len(episode)

    def drop(self, position: int) -> None:
        """Leave out the staged episode at `position`; its uid stays taken."""
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
        """Return whether the dataset at `root` holds every staged episode, value for value."""
        paths = self._paths()
        try:
            dataset = Dataset.open(self.root)
            staged = {episode.uid: path for path in paths for episode in [load_staged(path, self._columns)]}
            for stored in dataset.episodes([column.name for column in self._columns]) if staged else ():
                if path := staged.pop(stored.uid, None):
                    one = load_staged(path, self._columns)
                    same = (np.array_equal(v, stored.columns[name]) for name, v in one.columns.items())
                    if one.metadata != stored.metadata or not all(same):
                        return False
        except AstraDataError:
            return False
        settings = read_object(self.folder / _SETTINGS)
        before = settings.get("description") if isinstance(settings, dict) else None
        described = before if isinstance(before, dict) else self._settings["description"]
        return not staged and (bool(paths) or described.items() <= dataset.description.items())

    def _path(self, position: int) -> Path:
        return self.folder / f"{position:06d}.arrow"

    def _agree_on_the_settings(self) -> None:
        """Write the settings, or check that what was staged was made with the same."""
        before = read_object(self.folder / _SETTINGS)
        if isinstance(before, dict):
            if differing := ", ".join(key for key, *_ in changed_values(before, self._settings)):
                raise BadInputError(
                    f"{self.root}: the interrupted recording differs in {differing}; "
                    f"resume it with the same settings, or delete {self.folder}."
                )
        elif self._holds_work():
            raise BadInputError(
                f"{self.folder} holds {self._left()}, but {_SETTINGS} {before}, so that nobody knows "
                f"of which recording: delete the folder to start again."
            )
        else:
            durable.write_file(self.folder / _SETTINGS, json.dumps(self._settings, indent=1, sort_keys=True))


def write_staged(path: Path, episode: Episode, schema: pa.Schema) -> None:
    """Write the columns of `schema`, with their digests, uid and metadata."""
    facts = {
        "uid": episode.uid,
        "metadata": dict(episode.metadata),
        "digests": {name: digest_of(episode.columns[name]) for name in schema.names},
    }
    arrays = [to_arrow(episode.columns[field.name], field.type) for field in schema]
    schema = schema.with_metadata({"episode": json.dumps(facts)})
    with path.open("wb") as sink, pa.ipc.new_file(sink, schema) as file:
        file.write_table(pa.Table.from_arrays(arrays, schema=schema))


def load_staged(path: Path, columns: Sequence[Column]) -> Episode:
    """Return the episode in the file at `path`."""
    try:
        if not path.is_file():
            raise OSError("it is no file")
        with pa.memory_map(str(path)) as source, pa.ipc.open_file(source) as file:
            table = file.read_all()
            facts = json.loads(table.schema.metadata[b"episode"])
            values = {c.name: to_numpy(table.column(c.name), c.size, c.dtype) for c in columns}
            uid, metadata, digests = facts["uid"], facts["metadata"], facts["digests"]
            altered = [name for name, digest in digests.items() if digest_of(values[name]) != digest]
    except (OSError, pa.ArrowException, AttributeError, KeyError, TypeError, ValueError) as error:
        raise CorruptDatasetError(
            f"{path} is no whole episode ({in_short(error)}); delete it and resume the recording."
        ) from error
    if altered:
        raise CorruptDatasetError(f"{path} was altered in {', '.join(altered)}; delete it and resume the recording.")
    return Episode(uid, values, metadata)
