"""Read a dataset: whole columns as contiguous arrays, or one episode at a time."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from astra_data.core.arrays import Ints
from astra_data.core.errors import BadInputError, CorruptDatasetError, optional
from astra_data.core.naming import RECORD, first_few
from astra_data.dataset.cameras import clip_fault, decoded
from astra_data.dataset.columns import RESERVED, SUCCESS, Array, Column, Episode
from astra_data.dataset.contents import Contents, read_contents, read_values
from astra_data.dataset.description import Digests, alteration, altered_columns, full_name, identity_of, read_digests
from astra_data.dataset.format import CODEBASE_VERSION, INFO_PATH, OUR_FOLDER, STATS_PATH
from astra_data.dataset.lerobot_recording import open_recording
from astra_data.dataset.lerobot_rows import declared_columns
from astra_data.dataset.plain import data_files, is_format_2, read_object
from astra_data.dataset.statistics import ranges

if TYPE_CHECKING:
    import datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset


REPAIR = "astra-data repair {} --out DIR"  # the command that writes what is intact in a folder to another one
_SHOWN = 4  # datasets of a run


class Dataset(Contents):
    """A finished dataset of E episodes and N steps; make one with `Dataset.open`.

    Example:
        >>> from astra_data import Dataset
        >>> data = Dataset.open("walks")
        >>> data.reference, len(data)
        ('walks@data-1.0.0', 12)
        >>> data.columns(["action"])["action"].shape  # (N, A)
        (240, 2)
    """

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
            is_ours = (root / OUR_FOLDER).is_dir() or not (root / INFO_PATH).is_file()
            return cls(**vars(read_contents(root) if is_ours else open_recording(root)))

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
        return full_name(self.description)

    @property
    def content_hash(self) -> str:
        """The sha256 over the values of all columns."""
        return str(self.description["content_hash"])

    @property
    def identity(self) -> dict[str, str]:
        """Name, version and hash, as the datasets made from this one list them among their parents."""
        return identity_of(self.description)

    def __len__(self) -> int:
        """Return the number of episodes E."""
        return len(self.lengths)

    def __repr__(self) -> str:
        """Show name, version, size and columns."""
        columns = ", ".join([*(f"{c.name} ({c.size}) {c.dtype}" for c in self.schema), *self.cameras])
        return f"Dataset({self.reference}, {len(self)} episodes, {self.lengths.sum()} steps, {columns})"

    def columns(self, names: Sequence[str], episodes: Collection[int] | None = None) -> dict[str, Array]:
        """Return whole columns by name, contiguous (n, size), or (n,) where there is one value per step.

        The n steps are those of `episodes`, by default of all, given as indices; they come in the dataset's
        order.

        Raises:
            CorruptDatasetError: a file cannot be read, or values differ from their digests.
        """
        rows, row = int(self.lengths[self.selected(episodes)].sum()), 0
        out = {c.name: np.empty((rows, c.size) if c.size > 1 else rows, c.dtype) for c in self.specs(names)}
        for block in self.blocks(names, episodes):
            end = row + len(next(iter(block.values())))
            for name, values in block.items():
                out[name][row:end] = values
            row = end
        return out

    def blocks(self, names: Sequence[str], episodes: Collection[int] | None = None) -> Iterator[dict[str, Array]]:
        """Yield the values of the columns `names` in blocks of whole episodes; memory stays bounded."""
        for block, _ in self._verified(self.specs(names), self.selected(episodes)):
            yield block

    def selected(self, episodes: Collection[int] | None) -> NDArray[np.int64]:
        """Return the episode indices `episodes`, by default all, in the dataset's order."""
        if episodes is None:
            return np.arange(len(self))
        chosen, counts = np.unique(np.array(list(episodes), dtype=np.int64), return_counts=True)
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
                metadata = {key: values[episode] for key, values in self.metadata.items()}
                known = {key: value for key, value in metadata.items() if value is not None}
                clips = {name: camera.clips[episode] for name, camera in self.cameras.items()}
                yield Episode(int(self.uids[episode]), columns, known, clips)

    def pictures(self, camera: str, episode: int) -> NDArray[Any]:
        """Return the decoded pictures of an episode, by index: (T, H, W, 3) uint8, or (T, H, W) uint16 of depths."""
        if camera not in self.cameras:
            known = ", ".join(self.cameras) or "none"
            raise BadInputError(f"{self.reference} has no camera {camera!r}; it has {known}")
        return decoded(self.cameras[camera].clips[self.selected([episode])[0]])

    def successes(self) -> list[bool | None] | None:
        """Return whether each episode succeeded, by metadata or next.success; None where or if it is unknown."""
        stored = self.metadata.get("success", [None])
        known = [None if value is None or isinstance(value, str) else bool(value) for value in stored]
        if None in known and SUCCESS in self.features:
            return [bool(episode.columns[SUCCESS].any()) for episode in self.episodes([SUCCESS])]
        return None if set(known) == {None} else known

    def subset(self, count: int) -> list[int]:
        """Return `count` episode indices; smaller subsets are prefixes of larger ones."""
        if not 1 <= count <= len(self):
            raise BadInputError(f"{self.reference}: a subset of {count} episodes, expected 1 to {len(self)}.")
        return self.order[:count]

    def statistics(self) -> dict[str, dict[str, Any]]:
        """Return meta/stats.json, column to statistic to values; of a recording, min, max and mean."""
        return self._statistics

    @cached_property
    def _statistics(self) -> dict[str, dict[str, Any]]:
        if self.recorded is not None:  # for which all values are read
            return ranges(self.blocks([column.name for column in self.schema]))
        found = read_object(self.root / STATS_PATH)
        if isinstance(found, str):
            raise CorruptDatasetError(f"{self.root}: {STATS_PATH} {found}; astra-data repair rebuilds it")
        return found

    def verify(self) -> list[str]:
        """Read every value again, LeRobot's own columns included; return what was altered, if anything."""
        try:
            blocks = read_values(self, self.specs(list(self.features)), self.selected(None))
            faults = [fault for block, indices in blocks for fault in self.alterations(block, indices)]
            clips = (clip for camera in self.cameras.values() for clip in camera.clips)
            return faults + [fault for clip in clips if (fault := clip_fault(clip))]
        except CorruptDatasetError as error:
            return [str(error)]

    def require_whole(self) -> None:
        """Read every value, for what states something of all of them."""
        for _ in self.blocks(list(self.features)):
            pass

    def to_huggingface(self) -> "datasets.Dataset":
        """Return the rows as a `datasets.Dataset` in memory, once all values are verified."""
        self.require_whole()
        table = pa.concat_tables(map(pq.read_table, data_files(self.root)))
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
    def digests(self) -> Digests:
        """Those of the values as they were written, or as they were when a recording was opened."""
        return self.recorded.digests if self.recorded else read_digests(self.root, self.features)

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
            if altered := altered_columns(values, episode, self.digests):
                start = int(self.starts[episode])
                file = int(np.searchsorted(self.file_starts, start, side="right")) - 1
                row = start - int(self.file_starts[file])
                yield alteration(altered, self.paths[file], row, int(self.lengths[episode]), episode)

    def specs(self, names: Sequence[str]) -> list[Column]:
        """Return the columns `names`."""
        if isinstance(names, str):
            raise BadInputError(f"expected a list of columns, got the text '{names}': write ['{names}']")
        if unknown := ", ".join(name for name in names if name not in self.features):
            raise BadInputError(f"{self.reference} has no column {unknown}; it has {', '.join(self.features)}.")
        return [Column.from_feature(name, self.features[name]) for name in names]


def refuse_others(root: Path) -> None:
    """Raise BadInputError where `root` holds no dataset, versions of one, or one of another format."""
    refuse_versions(root)
    fault = format_fault(root)
    if not fault and not (root / "meta").is_dir():
        refuse_run(root)
        logs = sorted(path.name for path in root.glob("*.[cC][sS][vV]"))
        fault = (
            f"{root} contains logs ({logs[0]} and so on): make them a dataset with `astra-data import` and a "
            "mapping, which `astra-data new` writes"
            if logs
            else f"{root}: found no dataset; check the path (`astra-data list` shows where names are) or run the "
            "stage that writes it."
        )
    if fault:
        raise BadInputError(fault)


def format_fault(root: Path) -> str | None:
    """Return a sentence if the dataset in `root` is LeRobot's and of another format than ours."""
    info = read_object(root / INFO_PATH)
    version = info.get("codebase_version") if isinstance(info, dict) else CODEBASE_VERSION
    if version == CODEBASE_VERSION or (root / OUR_FOLDER).is_dir():
        return None
    found = f"{root} has LeRobot's format {version}, expected {CODEBASE_VERSION}"
    if not is_format_2(root):
        return f"{found}: convert it with a version of lerobot that reads both"
    return f"{found}: convert it with lerobot's convert_dataset_v21_to_v30, or {REPAIR.format(root)}"


def refuse_versions(root: Path) -> None:
    """Raise BadInputError where `root` holds versions of a dataset; name them."""
    versions = sorted(path.name for path in root.glob("data-*.*.*") if (path / INFO_PATH).is_file())
    if versions:
        raise BadInputError(f"{root} contains versions of a dataset: name one of {', '.join(versions)}.")


def refuse_run(root: Path) -> None:
    """Raise BadInputError where `root` is the folder of a run; name the datasets in it."""
    if not (root / RECORD).is_file():
        return
    places = ("*/seed_*", "*/percent_*/seed_*")
    found = sorted(info.parents[1] for place in places for info in root.glob(f"{place}/{INFO_PATH}"))
    held = f"its datasets are {first_few(found, _SHOWN)}" if found else "it has no datasets yet"
    raise BadInputError(f"{root} is a run; {held}")


@contextmanager
def explained(root: Path) -> Iterator[None]:
    """Say of a CorruptDatasetError, or of missing metadata, which dataset it is and what can be done."""
    try:
        yield
    except (CorruptDatasetError, KeyError) as error:
        fault = f"{error} is missing in its metadata" if isinstance(error, KeyError) else error
        others = " or run the stage that wrote it again"
        if can_be_repaired(root):
            repair = f"`astra-data repair {root} --out FOLDER`"
            others = f", run the stage that wrote it again, or recover its intact episodes: {repair}"
        advice = f"Restore it from a copy{others}."
        raise CorruptDatasetError(f"{root} is incomplete or was altered: {fault}. {advice}") from error


def can_be_repaired(root: Path) -> bool:
    """Return whether columns and rate of the dataset in `root` are known, without which no value is."""
    info = read_object(root / INFO_PATH)
    try:
        return not isinstance(info, str) and bool(declared_columns(root, info))
    except CorruptDatasetError:
        return False
