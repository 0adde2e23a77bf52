"""Validation of the episodes that are added to a dataset."""

from collections.abc import Mapping, Sequence

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import DONE, TERMINATED, TRUNCATED, Array, Column, Episode, Scalar
from astra_data.dataset.format import METADATA_KEYS

MOST_CHARACTERS = 2**20
"""Characters of a text in the metadata."""


class Admission:
    """Checks each new episode against the dataset's columns and against the episodes before it.

    Attributes:
        metadata_types: type of each metadata key seen so far.
    """

    def __init__(self, columns: Sequence[Column]) -> None:
        self._columns = {column.name: column for column in columns}
        self._uids: set[int] = set()
        self.metadata_types: dict[str, type] = {}

    def admit(self, episode: Episode) -> None:
        """Accept `episode`, or refuse it.

        Raises:
            BadInputError: it does not fit; lists every fault.
        """
        self.check(episode)
        self._uids.add(episode.uid)
        self.metadata_types |= {key: type(value) for key, value in episode.metadata.items()}

    def check(self, episode: Episode) -> None:
        """Refuse `episode` as `admit` does, without accepting it otherwise.

        Raises:
            BadInputError: it does not fit; lists every fault.
        """
        if not isinstance(episode, Episode):
            kind = type(episode).__name__
            raise BadInputError(f"expected an Episode, made with Episode(uid, columns), got a {kind}")
        faults = self._faults(episode)
        if faults:
            raise BadInputError(f"Episode {episode.uid}: {'; '.join(faults)}.")

    def _faults(self, episode: Episode) -> list[str]:
        faults = [f"{name}: missing" for name in self._columns if name not in episode.columns]
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
        faults += _outcome_faults(episode.columns)
        if episode.uid in self._uids:
            faults.append("an earlier episode has the same uid")
        return faults


def is_text(value: str) -> bool:
    """Return whether `value` can be written as UTF-8; names of files that are not UTF-8 cannot."""
    return not any("\ud800" <= character <= "\udfff" for character in value)


def _metadata_faults(key: str, value: Scalar) -> list[str]:
    """List why a value of the metadata cannot be stored."""
    if not isinstance(key, str) or not is_text(key) or not 0 < len(key) <= MOST_CHARACTERS:
        return [f"metadata {key!r:.80}: expected a text of valid characters as its name"]
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        return [f"metadata {key}: an integer of more than 64 bits"]
    if isinstance(value, str) and len(value) > MOST_CHARACTERS:
        return [f"metadata {key}: {len(value):,} characters, expected at most {MOST_CHARACTERS:,}"]
    if isinstance(value, str) and not is_text(value):
        return [f"metadata {key}: {value!r:.80} has characters that are not valid Unicode"]
    return []


def _outcome_faults(columns: Mapping[str, Array]) -> list[str]:
    """List faults of the flags that end an episode, as far as they are flags: only its last step may."""
    flags = {
        name: ends
        for name in (TERMINATED, TRUNCATED, DONE)
        if (ends := columns.get(name)) is not None and ends.dtype == bool and ends.ndim == 1
    }
    faults = [
        f"{name}: true in frame {int(ends.argmax())}, expected in the last one only"
        for name, ends in flags.items()
        if ends[:-1].any()
    ]
    if DONE in flags and not flags[DONE][-1]:
        faults.append(f"{DONE}: false in the last frame, expected true: an episode ends there")
    if len(flags) == 3 and flags[DONE][-1] and not (flags[TERMINATED][-1] or flags[TRUNCATED][-1]):
        faults.append(f"{DONE}: true in the last frame, expected {TERMINATED} or {TRUNCATED} there, too")
    return faults
