"""MCAP: messages of asynchronous topics, as JSON, protobuf or ROS 2 (CDR), resampled to fps.

From the time when every topic has sent a message, a row is taken every 1 / fps seconds; each value is the
topic's last one at that time (zero-order hold). A topic that is silent for longer than `split.gap_s` ends the
episode, and the next begins when all have sent a message again; where all are silent for as long, it ends
with the last message. Times are the messages' log times. Files are read message by message.
"""

import json
import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.core.optional import optional
from astra_data.dataset.columns import Array
from astra_data.exchange.mapping import ImportMapping
from astra_data.exchange.recording import BLOCK_ROWS, Block, Source

SUFFIXES = (".mcap",)

_log = logging.getLogger(__name__)

MOST_HELD_ROWS = 10**6
"""Most rows in which the same values may be held: five hours at 50 Hz."""


class Resampler:
    """Holds the last values of all topics and samples rows from them.

    Attributes:
        topics: topic to its fields.
        times: topic to the time of its last message, in ns.
        silences: topic to how often it ended an episode: it was silent for too long, and others were not.
    """

    def __init__(self, mapping: ImportMapping, origin: str) -> None:
        """Sample the fields of `mapping` from the file `origin`."""
        self._origin = origin
        self.topics: dict[str, list[str]] = {}
        self.times: dict[str, int] = {}
        self.silences: Counter[str] = Counter()
        for field in mapping.all_fields:
            self.topics.setdefault(field.partition(":")[0], []).append(field)
        expiring = {f for column in mapping.columns.values() if not column.latched for f in column.fields}
        self._expiring = {field.partition(":")[0] for field in expiring}
        self._gap_ns = round((mapping.split.gap_s or 0) * 1e9)
        self._fps = mapping.fps
        self._values: dict[str, Array] = {}
        self._start: int | None = None
        self._row = 0

    def receive(self, topic: str, time: int, values: Mapping[str, Array]) -> None:
        """Update the values of `topic` with a message at `time` ns."""
        self._values |= values
        self.times[topic] = time
        if self._start is None and self._is_complete(time):
            self._start, self._row = time, 0

    def rows_before(self, time: int) -> Iterator[tuple[bool, dict[str, Array]]]:
        """Yield the rows before `time` that have not been sampled yet, and whether each begins an episode.

        Raises:
            BadInputError: these are more than `MOST_HELD_ROWS`.
        """
        if self._is_pause(time):
            yield from self.rows_before(max(self._heard()) + 1)
            self._start = None
        self._refuse_gap(time)
        while self._start is not None:
            moment = self._start + self._row * 10**9 // self._fps
            if moment >= time:
                return
            if silent := self._silent(moment):
                self._start = None
                self.silences.update(silent)
                return
            yield self._row == 0, dict(self._values)
            self._row += 1

    def _refuse_gap(self, time: int) -> None:
        if self._start is None:
            return
        moment = self._start + self._row * 10**9 // self._fps
        end = min(time, *(self.times[topic] + self._gap_ns for topic in self._expiring))
        if (rows := (end - moment) * self._fps // 10**9) > MOST_HELD_ROWS:
            raise BadInputError(
                f"{self._origin}: nothing new comes between {moment} and {time} ns, which would be {rows} "
                f"equal rows, expected at most {MOST_HELD_ROWS}: a time is wrong, or split.gap_s is too long"
            )

    def _is_pause(self, time: int) -> bool:
        """Return whether all topics that are not latched were silent for too long before `time`."""
        return bool(heard := self._heard()) and time - max(heard) > self._gap_ns

    def _heard(self) -> list[int]:
        return [self.times[topic] for topic in self._expiring & self.times.keys()]

    def _is_complete(self, time: int) -> bool:
        return self.times.keys() == self.topics.keys() and not self._silent(time)

    def _silent(self, time: int) -> list[str]:
        """Return the topics that may not be silent for so long as they were before `time`; all were heard."""
        return [topic for topic in self._expiring if time - self.times[topic] > self._gap_ns]


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield rows at the rate `mapping.fps`.

    Raises:
        BadInputError: topics or parts of messages are missing; lists all of them.
    """
    _check_mapping(mapping, str(source))
    starts = False
    rows: list[dict[str, Array]] = []
    for begins, row in _rows(source, mapping):
        if rows and (begins or len(rows) == BLOCK_ROWS):
            yield _block(source, rows, starts)
            starts, rows = False, []
        starts |= begins
        rows.append(row)
    if rows:
        yield _block(source, rows, starts)


def _rows(source: Source, mapping: ImportMapping) -> Iterator[tuple[bool, dict[str, Array]]]:
    reading = optional("mcap.reader", "mcap")
    factories = [
        _Json(),
        optional("mcap_protobuf.decoder", "mcap").DecoderFactory(),
        optional("mcap_ros2.decoder", "mcap").DecoderFactory(),
    ]
    resampler, time = Resampler(mapping, str(source)), 0
    sizes: dict[str, tuple[int, ...]] = {}
    with source.open() as stream:
        reader = reading.make_reader(stream, validate_crcs=True, decoder_factories=factories)
        _check_topics(reader.get_summary(), list(resampler.topics), str(source))
        for _, channel, message, content in reader.iter_decoded_messages(topics=list(resampler.topics)):
            time = message.log_time
            values = _values(
                content, channel.topic, resampler.topics[channel.topic], f"{source} at {time} ns"
            )
            changed = [field for field, v in values.items() if sizes.setdefault(field, v.shape) != v.shape]
            if changed:
                raise BadInputError(f"{source} at {time} ns: {', '.join(changed)} changes in size")
            yield from resampler.rows_before(time)
            resampler.receive(channel.topic, time, values)
    yield from resampler.rows_before(time + 1)
    silent = sorted(resampler.topics.keys() - resampler.times.keys())
    if silent:
        raise BadInputError(f"{source}: no messages on {', '.join(silent)}")
    for topic, times in resampler.silences.items():
        _log.warning(
            "%s: %s is silent for over split.gap_s %d times while others are not, and episodes end there: "
            "set latched = true where it is sent on change, or a longer gap_s",
            source,
            topic,
            times,
        )


def _block(source: Source, rows: list[dict[str, Array]], starts: bool) -> Block:
    return Block({field: np.stack([row[field] for row in rows]) for field in rows[0]}, str(source), starts)


def _check_mapping(mapping: ImportMapping, origin: str) -> None:
    faults = [
        f"field '{field}', expected '/topic:path.in.message'"
        for field in mapping.all_fields
        if not all(field.partition(":"))
    ]
    if mapping.split.gap_s is None:
        faults.append("split.gap_s is missing: the longest time for which a topic's last value is held")
    if mapping.time is not None:
        faults.append("time: leave it out, the messages' log times are used")
    if all(column.latched for column in mapping.columns.values()):
        faults.append("every column is latched, expected one that is not")
    if faults:
        raise BadInputError(f"{origin}: {'; '.join(faults)}")


def _check_topics(summary: Any, topics: list[str], origin: str) -> None:  # noqa: ANN401 - of mcap
    known = {channel.topic for channel in summary.channels.values()} if summary else set(topics)
    missing = [
        f"no topic '{topic}'{did_you_mean(topic, sorted(known))}" for topic in topics if topic not in known
    ]
    if missing:
        raise BadInputError(f"{origin}: {'; '.join(missing)}")


def _values(content: Any, topic: str, fields: list[str], origin: str) -> dict[str, Array]:  # noqa: ANN401 - any message
    values, faults = {}, []
    for field in fields:
        part = content
        for key in field.removeprefix(f"{topic}:").split("."):
            part = _part(part, key)
        is_list = hasattr(part, "__len__") and not isinstance(part, str | Mapping)
        value = np.array(list(part) if is_list else part)
        if value.dtype.kind not in "biufU":
            faults.append(f"'{field}' is neither a number nor a list of numbers")
        values[field] = value
    if faults:
        raise BadInputError(f"{origin}: {'; '.join(faults)}")
    return values


def _part(value: Any, key: str) -> Any:  # noqa: ANN401 - any message
    """Return part `key` of a message, None where there is none."""
    if isinstance(value, Mapping):
        return value.get(key)
    if key.isdecimal():
        return value[int(key)] if hasattr(value, "__len__") and int(key) < len(value) else None
    return getattr(value, key, None)


class _Json:
    """Decodes JSON messages, with or without a schema."""

    def decoder_for(self, message_encoding: str, schema: object) -> Callable[[bytes], object] | None:
        """Return the decoder, None for other encodings."""
        return json.loads if message_encoding == "json" else None
