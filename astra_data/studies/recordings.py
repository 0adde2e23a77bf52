"""Recordings of a robot: datasets and logs → pieces of rows; rows that do not count are marked."""

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Floats, as_rows
from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, NEXT_STATE, STATE, TERMINATED
from astra_data.dataset.format import INFO_PATH
from astra_data.dataset.inspection import is_terminated, stands_still
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import Version, locate
from astra_data.io.importing import import_dataset, log_suffixes
from astra_data.io.mapping import read_mapping
from astra_data.io.recording import find_sources, is_archive
from astra_data.studies.body import Body, Reading


@dataclass(frozen=True, eq=False)
class Piece:
    """N rows of one recording without a split.

    Attributes:
        recording: its name.
        state: before each row and after the last, (N + 1, S): of a walk [x, y, heading, ball x, ball y] in m
            and rad, of joints their positions.
        action: in each row, (N, A): of a walk (turn, forward, left, kick), of joints their targets; A is 0
            where no targets were recorded.
        broken: rows that do not count, (N,). body: what they are of.
    """

    recording: str
    state: Floats
    action: Floats
    broken: NDArray[np.bool_]
    body: Body

    def __len__(self) -> int:
        """Return N."""
        return len(self.action)


@dataclass(frozen=True, eq=False)
class Recording:
    """One recording, imported.

    Attributes:
        name: of its file or folder. content_hash: of the dataset's values.
        fps: rows per second. pieces: in their order.
    """

    name: str
    content_hash: str
    fps: int
    pieces: tuple[Piece, ...]

    @property
    def rows(self) -> int:
        """Rows of all pieces."""
        return sum(map(len, self.pieces))

    @property
    def minutes(self) -> float:
        """Length of all pieces."""
        return self.rows / self.fps / 60

    @property
    def broken_share(self) -> float:
        """Share of the rows that do not count."""
        return float(sum(piece.broken.sum() for piece in self.pieces) / self.rows)


def read_recordings(place: Path, mapping: Path, home: Path, config: Reading) -> list[Recording]:
    """Read every recording in `place`, and import by `mapping` those that are not datasets yet.

    Args:
        place: a dataset or its name, a log, an archive of logs, or a folder of any of these; each archive and
            each dataset is one recording, and each loose log of a folder, or all of these where the mapping
            has `split.files = false`.
        mapping: how logs become columns.
        home: folder where imported datasets are kept, so that none is imported twice.
        config: which body they are of, and which rows count.

    Raises:
        BadInputError: a part of `place` is not usable, or two are the same, or there is none; the message
            says why.
    """
    if not os.path.exists(place):
        try:
            place = locate(place)
        except BadInputError as error:
            raise BadInputError(
                f"{place} does not exist: expected a dataset, or logs that {mapping} describes ({error})"
            ) from None
    settings = read_mapping(mapping)
    suffixes = log_suffixes(settings)
    found, faults = [], []
    parts_of: dict[str, list[str]] = {}
    for part in _parts(place, suffixes, each=settings.split.files):
        try:
            found.append(_recording(part, mapping, suffixes, home, config))
        except BadInputError as error:
            faults.append(str(error))
        else:
            parts_of.setdefault(found[-1].content_hash, []).append(str(part))
    if not found:
        endings = " or ".join(suffixes)
        reasons = "; ".join(faults) or f"it has no datasets, no archives and no {endings} files"
        raise BadInputError(f"{place}: expected recordings of a robot, found none: {reasons}")
    if faults:
        raise BadInputError(f"{place}: {'; '.join(faults)}; move aside what is not a recording")
    if copies := [" and ".join(parts) for parts in parts_of.values() if len(parts) > 1]:
        raise BadInputError(f"{'; '.join(copies)} hold the same rows: move all but one aside")
    names = Counter(recording.name for recording in found)
    return [_apart(recording) if names[recording.name] > 1 else recording for recording in found]


def _apart(recording: Recording) -> Recording:
    """Return it under a name that no other recording has: that with the beginning of its hash."""
    name = f"{recording.name}-{recording.content_hash[:8]}"
    return replace(
        recording, name=name, pieces=tuple(replace(piece, recording=name) for piece in recording.pieces)
    )


def _parts(place: Path, suffixes: tuple[str, ...], *, each: bool) -> Iterator[Path]:
    """Yield the file or folder of each recording in `place`; of loose logs, `each` or their folder."""
    if place.is_file() or (place / INFO_PATH).is_file():
        yield place
        return
    inside = sorted(path for path in place.iterdir() if not path.name.startswith("."))
    logs = [path for path in inside if path.is_file() and path.name.endswith(suffixes)]
    if logs:
        yield from logs if each else [place]
    for path in inside:
        if is_archive(path) and path.is_file():
            yield path
        elif path.is_dir() and not logs:
            yield from _parts(path, suffixes, each=each)


def _recording(
    part: Path, mapping: Path, suffixes: tuple[str, ...], home: Path, config: Reading
) -> Recording:
    name, root = place_name(part), part
    if not (part / INFO_PATH).is_file():
        files = [source.path for source in find_sources(part, suffixes)]
        digests = "".join(file_digest(path) for path in dict.fromkeys([mapping, *files]))
        root = home / f"{name}-{sha256(digests.encode()).hexdigest()[:8]}"
        if not root.exists():
            import_dataset([part], mapping, out=root)
    dataset = Dataset.open(root)
    fps = int(dataset.info["fps"])
    pieces = tuple(_pieces(name, dataset, fps, config))
    if not pieces:
        raise BadInputError(f"{part} has no step: expected an episode of a row and the one after it")
    return Recording(name, dataset.content_hash, fps, pieces)


def place_name(place: Path) -> str:
    """Return the name of a recording or of a folder of recordings: its file name without endings.

    Of a version of a dataset it is the dataset's name and the version.
    """
    found = place.resolve() if os.path.exists(place) else locate(place)
    version = Version.from_tag(found.name)
    return f"{found.parent.name}-{version}" if version else found.name.partition(".")[0]


def _pieces(name: str, dataset: Dataset, fps: int, config: Reading) -> Iterator[Piece]:
    longest = max(1, round(config.piece_s * fps))
    body = config.body(dataset)
    columns = [STATE, NEXT_STATE, TERMINATED, *([ACTION] if body.given_size else [])]
    for episode in dataset.episodes(columns):
        before, after = (as_rows(episode.columns[name]) for name in (STATE, NEXT_STATE))
        # At its end the state may stand for a next state that the log does not have: that is no step.
        rows = len(episode) - (is_terminated(episode.columns) and stands_still(before[-1], after[-1]))
        if rows == 0:
            continue
        state = np.concatenate([before[:rows], after[rows - 1 : rows]]).astype(np.float64)
        recorded = episode.columns.get(ACTION, np.empty((len(episode), 0)))
        action = as_rows(recorded)[:rows].astype(np.float64)
        broken = config.broken(state, fps)
        for first in range(0, rows, longest):
            last = min(first + longest, rows)
            yield Piece(name, state[first : last + 1], action[first:last], broken[first:last], body)
