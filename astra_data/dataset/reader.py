"""Read a dataset: whole columns as contiguous arrays, or one episode at a time."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset.column_statistics import ranges
from astra_data.dataset.columns import RESERVED, SUCCESS, Array, Column, Episode
from astra_data.dataset.contents import Contents, read_contents
from astra_data.dataset.description import ContentHash
from astra_data.dataset.format import INFO_PATH
from astra_data.dataset.lerobot_recording import open_recording
from astra_data.dataset.parquet import read_arrays
from astra_data.dataset.plain import read_statistics


class Dataset(Contents):
    """A finished dataset of E episodes and N steps; make one with `Dataset.open`.

    Example:
        >>> from astra_data import Dataset
        >>> data = Dataset.open("walks")
        >>> data.reference, len(data)
        ('walks@data-1.0.0', 12)
        >>> data.columns(["action"])["action"].shape  # (N, A)
        (720, 2)
    """

    @classmethod
    def open(cls, root: Path | str) -> "Dataset":
        """Open the dataset in folder `root`, ours or LeRobot's; `versions.open_dataset` also takes names.

        Raises:
            BadInputError: there is no dataset, or one of LeRobot without states or actions.
            CorruptDatasetError: it is incomplete or was altered; lists every fault.
        """
        root = Path(root)
        _refuse_others(root)
        with _explained(root):
            is_ours = (root / "meta/astra").is_dir() or not (root / INFO_PATH).is_file()
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
        return f"{self.description['name']}@data-{self.description['version']}"

    @property
    def content_hash(self) -> str:
        """The sha256 over the values of all columns."""
        return str(self.description["content_hash"])

    @property
    def identity(self) -> dict[str, str]:
        """Name, version and hash, as the datasets made from this one list them among their parents."""
        return {
            "name": self.description["name"],
            "version": self.description["version"],
            "hash": self.content_hash,
        }

    def __len__(self) -> int:
        """Return the number of episodes E."""
        return len(self.lengths)

    def __repr__(self) -> str:
        """Show name, version, size and columns."""
        columns = ", ".join(f"{c.name} ({c.size}) {c.dtype}" for c in self.schema)
        return f"Dataset({self.reference}, {len(self)} episodes, {self.lengths.sum()} steps, {columns})"

    def columns(self, names: Sequence[str], episodes: Collection[int] | None = None) -> dict[str, Array]:
        """Return whole columns by name, contiguous (n, size), or (n,) where there is one value per step.

        Args:
            names: names of the columns.
            episodes: indices of the episodes whose n steps are read, by default all; they come in the
                dataset's order.

        Raises:
            BadInputError: a column or an episode does not exist, or an episode is listed twice.
            CorruptDatasetError: a file cannot be read.
        """
        chosen = self.selected(episodes)
        rows = int(self.lengths[chosen].sum())
        specs = self.specs(names)
        out = {c.name: np.empty((rows, c.size) if c.size > 1 else rows, c.dtype) for c in specs}
        row = 0
        for block in self.blocks(names, episodes):
            for name, values in block.items():
                out[name][row : row + len(values)] = values
            row += len(next(iter(block.values()), ()))
        return out

    def blocks(
        self, names: Sequence[str], episodes: Collection[int] | None = None
    ) -> Iterator[dict[str, Array]]:
        """Yield the values of `columns` in blocks of rows; memory stays bounded."""
        specs = self.specs(names)
        wanted = None
        if episodes is not None:
            wanted = np.zeros(int(self.lengths.sum()), dtype=bool)
            for episode in self.selected(episodes):
                wanted[self.starts[episode] : self.starts[episode] + self.lengths[episode]] = True
        with _explained(self.root):
            if self.recorded is None:
                yield from read_arrays(self.paths, specs, wanted)
            else:
                yield from self.recorded.blocks(specs, self.selected(episodes))

    def selected(self, episodes: Collection[int] | None) -> NDArray[np.int64]:
        """Return the episode indices `episodes`, by default all, in the dataset's order.

        Raises:
            BadInputError: one does not exist or is listed twice; lists every fault.
        """
        if episodes is None:
            return np.arange(len(self))
        chosen, counts = np.unique(np.array(list(episodes), dtype=np.int64), return_counts=True)
        faults = [
            f"has no episode {episode}, expected 0 to {len(self) - 1}"
            for episode in chosen
            if not 0 <= episode < len(self)
        ]
        faults += [f"episode {episode} is listed twice" for episode in chosen[counts > 1]]
        faults += [] if len(chosen) else ["no episodes are listed"]
        if faults:
            raise BadInputError(f"{self.reference}: {'; '.join(faults)}.")
        return chosen

    def episodes(self, names: Sequence[str] | None = None) -> Iterator[Episode]:
        """Yield all episodes in order with the columns `names`, by default `schema`; memory stays bounded."""
        specs = self.schema if names is None else self.specs(names)
        rest: dict[str, Array] = {}
        episode = 0
        for block in self.blocks([c.name for c in specs]):
            rest = {name: np.concatenate([rest[name], block[name]]) for name in block} if rest else block
            first, rows = 0, len(next(iter(rest.values())))
            while episode < len(self) and (last := first + int(self.lengths[episode])) <= rows:
                metadata = {key: values[episode] for key, values in self.metadata.items()}
                yield Episode(
                    int(self.uids[episode]),
                    {name: values[first:last] for name, values in rest.items()},
                    {key: value for key, value in metadata.items() if value is not None},
                )
                first, episode = last, episode + 1
            rest = {name: values[first:] for name, values in rest.items()} if first < rows else {}

    def successes(self) -> list[bool | None] | None:
        """Return whether each episode succeeded, None where unknown; None if unknown of all.

        Taken from the episodes' metadata or, where some episode has none, from the column next.success.
        """
        known = [
            None if value is None or isinstance(value, str) else bool(value)
            for value in self.metadata.get("success", [None])
        ]
        if None in known and SUCCESS in self.features:
            return [bool(episode.columns[SUCCESS].any()) for episode in self.episodes([SUCCESS])]
        return None if set(known) == {None} else known

    def subset(self, count: int) -> list[int]:
        """Return `count` episode indices; smaller subsets are prefixes of larger ones.

        Raises:
            BadInputError: there are not that many episodes.
        """
        if not 1 <= count <= len(self):
            raise BadInputError(f"{self.reference}: a subset of {count} episodes, expected 1 to {len(self)}.")
        return self.order[:count]

    def statistics(self) -> dict[str, dict[str, Any]] | str:
        """Return meta/stats.json, column to statistic to values, or what is wrong with it.

        Of what LeRobot recorded, min, max and mean are computed from the values.
        """
        if self.recorded is None:
            return read_statistics(self.root)
        return ranges(self.blocks([column.name for column in self.schema]))

    def verify(self) -> list[str]:
        """Read every value again and compare the content hash; return what is wrong, empty if nothing is.

        The hash covers every column, LeRobot's own included. `doctor.check` finds the wrong value.
        """
        running = ContentHash()
        try:
            for block in self.blocks(list(self.features)):
                for name, values in block.items():
                    running.update(name, values)
        except CorruptDatasetError as error:
            return [str(error)]
        found = running.hexdigest()
        return (
            []
            if found == self.content_hash
            else [f"the content hash is {found}, expected {self.content_hash}"]
        )

    def specs(self, names: Sequence[str]) -> list[Column]:
        """Return the columns `names`.

        Raises:
            BadInputError: one does not exist.
        """
        unknown = [name for name in names if name not in self.features]
        if unknown:
            known = ", ".join(self.features)
            raise BadInputError(f"{self.reference} has no column {', '.join(unknown)}; it has {known}.")
        return [Column.from_feature(name, self.features[name]) for name in names]


def _refuse_others(root: Path) -> None:
    versions = sorted(path.name for path in root.glob("data-*.*.*") if (path / INFO_PATH).is_file())
    if versions:
        raise BadInputError(f"{root} holds versions of a dataset: name one of {', '.join(versions)}.")
    if not (root / "meta").is_dir():
        raise BadInputError(f"{root}: no dataset there; check the path or run the stage that writes it.")


@contextmanager
def _explained(root: Path) -> Iterator[None]:
    try:
        yield
    except (CorruptDatasetError, KeyError) as error:
        fault = f"{error} is missing in its metadata" if isinstance(error, KeyError) else error
        raise CorruptDatasetError(
            f"{root} is incomplete or was altered: {fault}. "
            f"Restore it from a copy, run the stage that wrote it again, or save what is whole of it: "
            f"`astra-data repair {root} --out FOLDER`."
        ) from error
