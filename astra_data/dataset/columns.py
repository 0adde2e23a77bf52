"""Names, types and meaning of every dataset column, and the episode that carries them.

Dimension letters, in every docstring of the toolkit: B batch, T steps, E episodes, N rows, S target state,
X abstract state, A action, G goal, O observation, Z latent.

A column with one value per step has shape (T,), all others (T, size): never (T, 1), never more dimensions.
"""

import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import as_column
from astra_data.core.errors import BadInputError, in_short, unmet
from astra_data.core.naming import is_text

STATE = "observation.state"  # (T, S) float32: the full target state s_t
GOAL = "observation.environment_state"  # (T, G) float32: the goal, if any; LeRobot's own policies need it to train
ACTION = "action"  # (T, A) float32: a_t, as given to the target environment and to the abstract simulator
NEXT_STATE = "next.observation.state"  # (T, S) float32: s_{t+1}, stored so that readers need not shift s_t
REWARD = "next.reward"  # (T,) float32: the target reward r_t
TERMINATED = "next.terminated"  # (T,) bool: the task ended, in success or failure; learners bootstrap unless it is set
TRUNCATED = "next.truncated"  # (T,) bool: time ran out
DONE = "next.done"  # (T,) bool: terminated or truncated
SUCCESS = "next.success"  # (T,) bool: the goal is reached in s_{t+1}
ABSTRACT_STATE = "abstract.state"  # (T, X) float32: the abstract state of s_t
ABSTRACT_NEXT_STATE = "abstract.next_state"  # (T, X) float32: the abstract state of s_{t+1}
ABSTRACT_SIMULATED_NEXT_STATE = "abstract.simulated_next_state"
"""(T, X) float32: the abstract simulator's next state, from the abstract state of s_t under a_t."""
EPISODE_UID = "episode_uid"  # (T,) int64: identifies the episode through all later edits; filled in by the writer
TIMESTAMP, FRAME_INDEX = "timestamp", "frame_index"
EPISODE_INDEX, INDEX, TASK_INDEX = "episode_index", "index", "task_index"
RESERVED = (EPISODE_UID, TIMESTAMP, FRAME_INDEX, EPISODE_INDEX, INDEX, TASK_INDEX)  # filled in by the writer
DTYPES = ("float32", "int64", "bool")
MOST_VALUES, MOST_NAME_BYTES = 2**20, 200  # of a column: values per step, and bytes of its name, which names files, too
MOST_CHARACTERS = 2**20  # characters of a text in the metadata
ROLES = {"position": 2, "vector": 2, "heading": 1, "quaternion": 4, "invariant": 1}
"""How a change of the planar frame acts on values (see `Column.astra`), and on how many of them at once."""
Array = NDArray[Any]
Scalar = float | int | bool | str


@dataclass(frozen=True)
class Column:
    """One column of a dataset.

    Attributes:
        name: on disk. LeRobot makes policy inputs of columns that begin with "observation" or "action".
        dtype: one of `DTYPES`.
        size: values per step.
        names: a name for each of them.
        meaning: one sentence.
        astra: "unit", "frame" and "role", each a list with one word per index. A role says how a
            rotation and shift of the planar frame act: "position" and "vector" come as consecutive (x, y)
            pairs, "heading" is an angle in rad, "quaternion" four consecutive values (w, x, y, z) that rotate
            from the body's frame to the world's, "invariant" values do not change, such as those in the
            body's frame.

    Example:
        >>> from astra_data import Column
        >>> velocity = Column("action", size=2, names=("v", "w"), astra={"unit": ["m/s", "rad/s"]})
        >>> velocity.feature()["shape"]
        [2]
    """

    name: str
    dtype: str = "float32"
    size: int = 1
    names: tuple[str, ...] | None = None
    meaning: str = ""
    astra: Mapping[str, list[str]] | None = None

    def __post_init__(self) -> None:
        size, names, astra = self.size, self.names, self.astra or {}
        words, texts = astra.get("role", []), [*(names or ()), self.meaning, *chain(*astra.values())]
        unknown = ", ".join(sorted(set(words) - set(ROLES)))
        is_named = 1 <= len(self.name.encode(errors="replace")) <= MOST_NAME_BYTES
        is_file = self.name not in (".", "..") and {"/", "\0"}.isdisjoint(self.name)
        checks = {
            f"the name must have 1 to {MOST_NAME_BYTES} bytes, without '/', and name a file": is_named and is_file,
            f"dtype {self.dtype!r} is not one of {', '.join(DTYPES)}": self.dtype in DTYPES,
            f"size {size}, expected 1 to {MOST_VALUES}": 1 <= size <= MOST_VALUES,
            f"{len(names or ())} names for {size} values": names is None or len(names) == size,
            "expected texts of valid characters in names, meaning and astra": all(map(is_text, texts)),
            **{f"astra has {key!r}, expected unit, frame, role": key in ("unit", "frame", "role") for key in astra},
            **{f"{len(of)} words in astra's {key} for {size} values": len(of) == size for key, of in astra.items()},
            f"unknown role {unknown}, expected {', '.join(ROLES)}": not unknown,
        }
        faults = unmet(checks) or [
            f"role {role} at index {group.start}, expected {ROLES[role]} indices of it side by side"
            for role, group in self.roles
            if words[group] != [role] * ROLES[role]
        ]
        if faults:
            raise BadInputError(f"Column {self.name[:MOST_NAME_BYTES]!r}: {'; '.join(faults)}.")

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each value; without names its index."""
        return self.names or tuple(map(str, range(self.size)))

    @property
    def units(self) -> list[str]:
        """The unit of each value; "" where it is not known."""
        return (self.astra or {}).get("unit", [""] * self.size)

    @property
    def roles(self) -> list[tuple[str, slice]]:
        """Each role with the indices that it acts on at once, in order; empty if roles are unknown."""
        groups, index, roles = [], 0, (self.astra or {}).get("role", [])
        while index < len(roles):
            width = ROLES[roles[index]]
            groups.append((roles[index], slice(index, index + width)))
            index += width
        return groups

    def feature(self) -> dict[str, Any]:
        """Return the column's entry in LeRobot's `features`."""
        astra: dict[str, Any] = {"meaning": self.meaning} if self.meaning else {}
        astra |= {key: list(words) for key, words in (self.astra or {}).items()}
        entry = {"dtype": self.dtype, "shape": [self.size], "names": self.names and list(self.names)}
        return entry | ({"astra": astra} if astra else {})

    @classmethod
    def from_feature(cls, name: str, feature: Mapping[str, Any]) -> "Column":
        """Rebuild a column from its entry in LeRobot's `features`."""
        try:
            astra = dict(feature.get("astra") or {})
            return cls(
                name=name,
                dtype=feature["dtype"],
                size=feature["shape"][0],
                names=None if feature.get("names") is None else tuple(feature["names"]),
                meaning=astra.pop("meaning", ""),
                astra=astra or None,
            )
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            wanted = "expected an object with dtype, shape, names and astra."
            found = f"meta/info.json has {feature!r:.200} in features"
            raise BadInputError(f"Column {name!r}: {found}, {wanted}") from error

    def faults(self, values: Array) -> list[str]:
        """List how the dtype and shape of `values` differ from the column's; empty if they fit."""
        wrong = [] if values.dtype == self.dtype else [f"{self.name}: dtype {values.dtype}, expected {self.dtype}"]
        if values.shape[1:] != (self.size,)[self.size == 1 :]:
            expected = "(T,)" if self.size == 1 else f"(T, {self.size})"
            wrong.append(f"{self.name}: shape {values.shape}, expected {expected}")
        return wrong


OUTCOME_COLUMNS = (
    Column(REWARD, meaning="target reward of the step"),
    Column(TERMINATED, "bool", meaning="the task ended: no value beyond it"),
    Column(TRUNCATED, "bool", meaning="time ran out"),
    Column(DONE, "bool", meaning="terminated or truncated"),
    Column(SUCCESS, "bool", meaning="the goal is reached after the step"),
)  # the outcome of a step, in every collected dataset


@dataclass(frozen=True)
class Clip:
    """`count` pictures of a file, one each `step` from `start` on: seconds of a video, rows of a parquet file."""

    path: Path
    camera: str
    start: float
    step: float
    count: int
    digest: str | None = None  # sha256 of the video, where it is known
    statistics: Mapping[str, Any] = field(default_factory=dict, compare=False)  # LeRobot's, of the recorded episode

    def part(self, first: int, end: int, every: int = 1) -> "Clip":
        """Return the pictures `first` to `end`, exclusive, each `every`-th."""
        count = (end - first) // every
        return replace(self, start=self.start + first * self.step, step=self.step * every, count=count)


@dataclass(frozen=True, repr=False, eq=False)
class Episode:
    """One episode of T steps.

    Attributes:
        uid: identifies the episode through all later edits, 0 <= uid < 2^63.
        columns: name to (T,) or (T, size) contiguous array of one of `DTYPES`, never one of the `RESERVED`
            names; values given as (T, 1), as Gymnasium has them, become (T,).
        metadata: facts about the whole episode (success, return, seed, source_episode, ...).
        cameras: the pictures of each camera, a clip of T.

    Raises:
        BadInputError: lists every fault, with column and first frame.

    Example:
        >>> import numpy as np
        >>> from astra_data import Episode
        >>> episode = Episode(0, {"action": np.zeros((5, 2), np.float32)}, {"floor": "carpet"})
        >>> episode.columns["action"].shape
        (5, 2)
    """

    uid: int
    columns: Mapping[str, Array]
    metadata: Mapping[str, Scalar] = field(default_factory=dict)
    cameras: Mapping[str, Clip] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Convert numpy scalars and array layouts, and validate the episode."""
        metadata = {k: v.item() if isinstance(v, np.generic) else v for k, v in self.metadata.items()}
        masked = [k for k, v in self.columns.items() if isinstance(v, np.ma.MaskedArray) and v.mask.any()]
        columns, faults = dict[str, Array](), list[str]()
        for name, values in self.columns.items():
            try:
                columns[name] = as_column(np.asarray(values, order="C"))
            except (RuntimeError, TypeError, ValueError) as error:  # tensors with gradients or bfloat16, uneven lists
                wanted = "expected an array, or tensor.detach().cpu().float() of a tensor"
                faults.append(f"{name}: {in_short(error)}; {wanted}")
        object.__setattr__(self, "metadata", metadata)
        object.__setattr__(self, "columns", columns)
        is_uid = type(self.uid) is int and 0 <= self.uid < 2**63
        faults += [] if is_uid else [f"uid {self.uid!r}, expected an int in [0, 2^63)"]
        faults += [f"{name}: masked values, expected a value for every step" for name in masked]
        faults += [fault for name, values in columns.items() for fault in _column_faults(name, values)]
        lengths = {name: len(values) for name, values in columns.items() if values.ndim}
        if len(set(lengths.values())) > 1:
            listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
            faults.append(f"columns differ in their number of steps ({listed})")
        elif not self.columns or 0 in lengths.values():
            faults.append("there are no steps" if columns else "there are no columns")
        faults += [fault for key, value in metadata.items() for fault in _metadata_faults(key, value)]
        if faults:
            raise BadInputError(f"Episode {self.uid}: {'; '.join(faults)}.")

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __repr__(self) -> str:
        shapes = ", ".join(f"{name} {values.shape} {values.dtype}" for name, values in self.columns.items())
        return f"Episode(uid={self.uid}, {shapes}, metadata={dict(self.metadata)})"


def _column_faults(name: str, values: Array) -> list[str]:
    faults = []
    if name in RESERVED:
        faults.append(f"{name}: is filled in by the writer, leave it out")
    if values.dtype not in DTYPES:
        faults.append(f"{name}: dtype {values.dtype}, expected one of {', '.join(DTYPES)}")
    if values.ndim not in (1, 2) or values.shape[1:] == (0,):
        faults.append(f"{name}: shape {values.shape}, expected (T,) or (T, size)")
    elif values.dtype.kind == "f" and not (finite := np.isfinite(values)).all():
        bad = np.argwhere(~finite)
        where = f"frame {bad[0][0]}" + (f" index {bad[0][1]}" if values.ndim == 2 else "")
        faults.append(f"{name}: {len(bad)} values are not finite, the first in {where}")
    return faults


def _metadata_faults(key: object, value: object) -> Iterator[str]:
    if not is_text(key) or not 0 < len(key) <= MOST_CHARACTERS:
        yield f"metadata {key!r:.80}: expected a text of valid characters as its name"
    elif not isinstance(value, Scalar):
        yield f"metadata {key}: {type(value).__name__}, expected float, int, bool or str"
    elif isinstance(value, float) and not np.isfinite(value):
        yield f"metadata {key}: {value}, expected a finite number"
    elif isinstance(value, int) and not -(2**63) <= value < 2**63:
        yield f"metadata {key}: an integer of more than 64 bits"
    elif isinstance(value, str) and len(value) > MOST_CHARACTERS:
        yield f"metadata {key}: {len(value):,} characters, expected at most {MOST_CHARACTERS:,}"
    elif isinstance(value, str) and not is_text(value):
        yield f"metadata {key}: {value!r:.80} has characters that are not valid Unicode"


def in_blocks(episodes: Iterable[Episode], rows: int) -> Iterator[list[Episode]]:
    """Yield successive episodes in lists: each ends when it has `rows` steps, or with the last episode."""
    block, steps = list[Episode](), 0
    for episode in episodes:
        block.append(episode)
        steps += len(episode)
        if steps >= rows:
            yield block
            block, steps = [], 0
    if block:
        yield block


def new_uid(uid: int, origin: bytes, known: Collection[int]) -> int:
    """Return a uid that is not among those `known`, always the same for `uid` of this `origin`."""
    while uid in known:
        uid = int.from_bytes(hashlib.sha256(origin + str(uid).encode()).digest()[:8]) >> 1
    return uid


def distinct_uids(found: Iterable[tuple[int, bytes]]) -> list[int]:
    """Return the uids of episodes found with uid and origin; those that an earlier one has are new ones."""
    found = list(found)
    known, taken, names = {uid for uid, _ in found}, set[int](), list[int]()
    for uid, origin in found:
        names.append(new_uid(uid, origin, known) if uid in taken else uid)
        known.add(names[-1])
        taken.add(names[-1])
    return names


def renamed_metadata(uid: int, metadata: Mapping[str, Scalar], names: Mapping[int, int]) -> dict[str, Any]:
    """Return the metadata of the episode `uid` whose data's uids are replaced by `names`: old to new."""
    renamed = dict(metadata)
    source = metadata.get("source_episode")
    if isinstance(source, int):
        renamed["source_episode"] = names.get(source, source)
    if names[uid] != uid:
        renamed["merged_uid"] = uid
    return renamed
