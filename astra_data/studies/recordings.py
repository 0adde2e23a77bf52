"""Recordings of a walking robot: datasets and logs → pieces of rows; rows that are not walking are marked."""

from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from astra_data.core.config import Config, Positive
from astra_data.core.digest import file_digest
from astra_data.core.errors import BadInputError
from astra_data.dataset import Dataset
from astra_data.dataset.columns import ACTION, NEXT_STATE, STATE, TERMINATED
from astra_data.dataset.format import INFO_PATH
from astra_data.exchange.importers import json
from astra_data.exchange.importing import import_dataset
from astra_data.exchange.recording import find_sources, is_archive
from astra_data.worlds.plane.geometry import wrapped

Floats = NDArray[np.float64]

STATE_NAMES = ("x", "y", "yaw", "ball_x", "ball_y")
ACTION_NAMES = ("turn", "forward", "left", "kick")


class WalkingConfig(Config):
    """When a robot counts as walking: not while it is carried, nor where self-localisation jumps."""

    jump_m: Positive = 0.06
    """A larger displacement between two rows is a jump of self-localisation: at 60 Hz, 3.6 m/s."""
    jump_rad: Positive = 0.1
    """The same for the change of heading."""
    fastest_m_s: Positive = 0.6
    """A robot that is faster over half a second is carried or corrects its position. Twice the maximum speed
    of the robot's walk engine."""
    piece_s: Positive = 30.0
    """Longer episodes are cut into pieces of this length, the unit of hold-out and of resampling."""


@dataclass(frozen=True, eq=False)
class Piece:
    """N rows of one recording without a split.

    Attributes:
        recording: its name.
        state: [x, y, heading, ball x, ball y] before each row and after the last, in m and rad, (N + 1, 5).
        action: (turn, forward, left, kick) in each row, (N, 4). broken: rows that are not walking, (N,).
    """

    recording: str
    state: Floats
    action: Floats
    broken: NDArray[np.bool_]

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
        """Share of the rows that are not walking."""
        return float(sum(piece.broken.sum() for piece in self.pieces) / self.rows)


def read_recordings(place: Path, mapping: Path, home: Path, config: WalkingConfig) -> list[Recording]:
    """Read every recording in `place`, and import by `mapping` those that are not datasets yet.

    Args:
        place: a dataset, a log, an archive of logs, or a folder of any of these; each archive and each
            dataset is one recording, and so are all loose logs of a folder.
        mapping: how logs become columns.
        home: folder where imported datasets are kept, so that none is imported twice.
        config: thresholds for walking.

    Raises:
        BadInputError: a part of `place` is not usable, or there is none; the message says why.
    """
    if not place.exists():
        raise BadInputError(f"{place} does not exist: expected a dataset, or logs that {mapping} describes")
    found, faults = [], []
    for part in _parts(place):
        try:
            found.append(_recording(part, mapping, home, config))
        except BadInputError as error:
            faults.append(str(error))
    if not found:
        reasons = "; ".join(faults) or "it has no datasets, no archives and no .json or .log files"
        raise BadInputError(f"{place}: expected recordings of a walking robot, found none: {reasons}")
    if faults:
        raise BadInputError(f"{place}: {'; '.join(faults)}; move aside what is not a recording")
    return found


def _parts(place: Path) -> Iterator[Path]:
    """Yield the file or folder of each recording in `place`."""
    if place.is_file() or (place / INFO_PATH).is_file():
        yield place
        return
    inside = sorted(path for path in place.iterdir() if not path.name.startswith("."))
    has_logs = any(path.is_file() and path.name.endswith(json.SUFFIXES) for path in inside)
    if has_logs:
        yield place
    for path in inside:
        if is_archive(path) and path.is_file():
            yield path
        elif path.is_dir() and not has_logs:
            yield from _parts(path)


def _recording(part: Path, mapping: Path, home: Path, config: WalkingConfig) -> Recording:
    name, root = place_name(part), part
    if not (part / INFO_PATH).is_file():
        files = [source.path for source in find_sources(part, json.SUFFIXES)]
        digests = "".join(file_digest(path) for path in dict.fromkeys([mapping, *files]))
        root = home / f"{name}-{sha256(digests.encode()).hexdigest()[:8]}"
        if not root.exists():
            import_dataset([part], mapping, out=root)
    dataset = Dataset.open(root)
    _check_names(dataset)
    fps = int(dataset.info["fps"])
    return Recording(name, dataset.content_hash, fps, tuple(_pieces(name, dataset, fps, config)))


def place_name(place: Path) -> str:
    """Return the name of a recording or of a folder of recordings: its file name without endings."""
    return place.resolve().name.partition(".")[0]


def _check_names(dataset: Dataset) -> None:
    expected = {STATE: STATE_NAMES, NEXT_STATE: STATE_NAMES, ACTION: ACTION_NAMES}
    found = {column.name: column.names for column in dataset.schema}
    faults = [
        f"{name} holds {', '.join(found.get(name) or ('no names',))}, expected {', '.join(names)}"
        for name, names in expected.items()
        if found.get(name) != names
    ]
    if faults:
        raise BadInputError(f"{dataset.reference}: {'; '.join(faults)}")


def _pieces(name: str, dataset: Dataset, fps: int, config: WalkingConfig) -> Iterator[Piece]:
    longest = round(config.piece_s * fps)
    columns = [STATE, NEXT_STATE, ACTION, TERMINATED]
    for episode in dataset.episodes(columns):
        # A terminated episode has no next state at its end in the log: the state itself stands in.
        rows = len(episode) - int(episode.columns[TERMINATED][-1])
        if rows == 0:
            continue
        following = episode.columns[NEXT_STATE][rows - 1 : rows]
        state = np.concatenate([episode.columns[STATE][:rows], following]).astype(np.float64)
        action = episode.columns[ACTION][:rows].astype(np.float64)
        broken = broken_rows(state, fps, config)
        for first in range(0, rows, longest):
            last = min(first + longest, rows)
            yield Piece(name, state[first : last + 1], action[first:last], broken[first:last])


def broken_rows(state: Floats, fps: int, config: WalkingConfig) -> NDArray[np.bool_]:
    """Return which rows (N,) between states (N + 1, 5) are not walking: jumps, and speeds above the limit."""
    place, heading = state[:, :2], state[:, 2]
    moved = np.linalg.norm(np.diff(place, axis=0), axis=1)
    broken = (moved > config.jump_m) | (abs(wrapped(np.diff(heading))) > config.jump_rad)
    half = min(fps // 2, len(moved))
    far = np.linalg.norm(place[half:] - place[:-half], axis=1) > config.fastest_m_s * half / fps
    for first in np.flatnonzero(far):
        broken[first : first + half] = True
    return np.asarray(broken)
