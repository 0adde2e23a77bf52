"""MCAP: messages of asynchronous topics, as JSON, protobuf or ROS 2 (CDR), resampled to fps.

Times are the messages' log times. Files are read message by message, twice: how often topics come decides
when rows are taken (`exchange/resampling.py`).
"""

import json
import logging
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError
from astra_data.core.optional import optional
from astra_data.dataset.columns import Array
from astra_data.exchange.mapping import ImportMapping
from astra_data.exchange.message_fields import MessageField
from astra_data.exchange.recording import BLOCK_ROWS, Block, Source
from astra_data.exchange.resampling import Resampler

SUFFIXES = (".mcap",)

_log = logging.getLogger(__name__)


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield rows at the rate `mapping.fps`.

    Raises:
        BadInputError: topics or parts of messages are missing; lists all of them.
    """
    _check_mapping(mapping, str(source))
    starts = False
    rows: list[dict[str, Array]] = []
    resampler = Resampler(mapping, str(source), _moments(source, mapping))
    for begins, row in _rows(source, resampler, _fields(mapping)):
        if rows and (begins or len(rows) == BLOCK_ROWS):
            yield _block(source, rows, starts)
            starts, rows = False, []
        starts |= begins
        rows.append(row)
    if rows:
        yield replace(_block(source, rows, starts), notes=resampler.unevenness())


def check(source: Source, mapping: ImportMapping) -> None:
    """Read the first message of each topic alone.

    Raises:
        BadInputError: topics or parts of these messages are missing.
    """
    _check_mapping(mapping, str(source))
    topics = _fields(mapping)
    with source.open() as stream:
        reader = optional("mcap.reader", "mcap").make_reader(stream, decoder_factories=_decoders())
        _check_topics(reader.get_summary(), list(topics), str(source))
        for topic, fields in topics.items():
            first = next(reader.iter_decoded_messages(topics=[topic]), None)
            if first is None:
                raise BadInputError(f"{source}: no messages on {topic}")
            _, _, message, content = first
            _values(content, fields, f"{source} at {message.log_time} ns")


def _decoders() -> list[Any]:
    return [
        _Json(),
        optional("mcap_protobuf.decoder", "mcap").DecoderFactory(),
        optional("mcap_ros2.decoder", "mcap").DecoderFactory(),
    ]


def _moments(source: Source, mapping: ImportMapping) -> dict[str, "array[int]"]:
    """Return the log times of the messages of each topic, in ns."""
    topics = list(dict.fromkeys(field.partition(":")[0] for field in mapping.all_fields))
    times: defaultdict[str, array[int]] = defaultdict(lambda: array("Q"))
    with source.open() as stream:
        reader = optional("mcap.reader", "mcap").make_reader(stream)
        _check_topics(reader.get_summary(), topics, str(source))
        for _, channel, message in reader.iter_messages(topics=topics):
            times[channel.topic].append(message.log_time)
    return times


def _rows(
    source: Source, resampler: Resampler, fields: dict[str, list[MessageField]]
) -> Iterator[tuple[bool, dict[str, Array]]]:
    reading = optional("mcap.reader", "mcap")
    time = 0
    sizes: dict[str, tuple[int, ...]] = {}
    with source.open() as stream:
        reader = reading.make_reader(stream, validate_crcs=True, decoder_factories=_decoders())
        for _, channel, message, content in reader.iter_decoded_messages(topics=list(resampler.topics)):
            time = message.log_time
            values = _values(content, fields[channel.topic], f"{source} at {time} ns")
            changed = [field for field, v in values.items() if sizes.setdefault(field, v.shape) != v.shape]
            if changed:
                raise BadInputError(f"{source} at {time} ns: {', '.join(changed)} changes in size")
            yield from resampler.rows_before(time)
            resampler.receive(channel.topic, time, values)
    yield from resampler.last_rows(time)
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


def _values(content: Any, fields: Sequence[MessageField], origin: str) -> dict[str, Array]:  # noqa: ANN401 - any message
    values, faults = {}, []
    for each in fields:
        try:
            values[each.name] = each.value(content)
        except BadInputError as error:
            faults.append(str(error))
    if faults:
        raise BadInputError(f"{origin}: {'; '.join(faults)}")
    return values


def _fields(mapping: ImportMapping) -> dict[str, list[MessageField]]:
    """Return the fields of each topic."""
    fields: dict[str, list[MessageField]] = {}
    for name in mapping.all_fields:
        of_message = MessageField(name)
        fields.setdefault(of_message.topic, []).append(of_message)
    return fields


class _Json:
    """Decodes JSON messages, with or without a schema."""

    def decoder_for(self, message_encoding: str, schema: object) -> Callable[[bytes], object] | None:
        """Return the decoder, None for other encodings."""
        return json.loads if message_encoding == "json" else None
