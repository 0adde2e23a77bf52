"""MCAP: messages of asynchronous topics, as JSON, protobuf or ROS 2 (CDR), resampled to fps.

Times are the messages' log times. Files are read message by message, twice: how often topics come decides
when rows are taken (`io/resampling.py`).
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Array
from astra_data.io.mapping import ImportMapping
from astra_data.io.mcap_file import McapFile, Timeline
from astra_data.io.message_fields import MessageField
from astra_data.io.recording import BLOCK_ROWS, Block, Source
from astra_data.io.resampling import Resampler

SUFFIXES = (".mcap",)
_COMPRESSED = (".mcap.zstd", ".mcap.zst")
_SQLITE = (".db3", ".db3.zstd")
BAGS = (*SUFFIXES, *_COMPRESSED, *_SQLITE)
"""Endings of the names of recordings of ROS, of which those in `SUFFIXES` are read."""

_log = logging.getLogger(__name__)


@dataclass
class _Rows:
    """Rows of one block, the topics' times in each, and how the block begins."""

    values: list[dict[str, Array]] = field(default_factory=list)
    times: list[dict[str, int]] = field(default_factory=list)
    starts: bool = False
    is_back: bool = False


def advice(names: Sequence[str]) -> str:
    """Say how to make MCAP of the files `names`, where another tool does; else nothing."""
    for name in names:
        if name.lower().endswith(_SQLITE):
            return (
                "a bag of ROS 2 in SQLite, expected MCAP: write `output_bags: [{uri: NEW, storage_id: mcap, "
                "all: true}]` to a file new.yaml, run `ros2 bag convert -i BAG -o new.yaml`, and import NEW"
            )
        if name.lower().endswith(_COMPRESSED):
            return f"{name} is compressed as a whole: run `zstd -d {name}`, and import the .mcap"
    return ""


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield rows at the rate `mapping.fps`.

    Raises:
        BadInputError: topics or parts of messages are missing; lists all of them.
    """
    if hint := advice([str(source)]):
        raise BadInputError(f"{source}: {hint}")
    _check_mapping(mapping, str(source))
    fields = _fields(mapping)
    file = McapFile(source, fields.keys())
    mapping, fields = _by_publisher(file, mapping, fields)
    gaps_s = [mapping.split.gap_s or 0, *(column.gap_s or 0 for column in mapping.columns.values())]
    timeline = Timeline(file, gaps_s[0], max(gaps_s))
    resampler = Resampler(mapping, str(source), timeline.moments)
    topic_of = {field.name: topic for topic, each in fields.items() for field in each}
    rows, known = _Rows(), sorted(file.topics - {field.topic for each in fields.values() for field in each})
    for begins, is_back, row, times in _rows(source, resampler, timeline, fields):
        if rows.values and (begins or len(rows.values) == BLOCK_ROWS):
            yield _block(source, rows, known, topic_of)
            rows = _Rows()
        rows.starts |= begins
        rows.is_back |= is_back
        rows.values.append(row)
        rows.times.append(times)
    if rows.values:
        yield replace(
            _block(source, rows, known, topic_of), torn=int(file.is_cut), notes=resampler.unevenness()
        )


def check(source: Source, mapping: ImportMapping) -> None:
    """Read the first message of each topic alone.

    Raises:
        BadInputError: topics or parts of these messages are missing.
    """
    _check_mapping(mapping, str(source))
    fields = _fields(mapping)
    file = McapFile(source, fields.keys())
    first: dict[str, Any] = {}
    for topic, message in file.messages(checked=False):
        first.setdefault(topic, message)
        if len(first) == len(fields):
            break
    file.check_topics()
    for topic in fields:
        if topic not in first:
            raise BadInputError(f"{source}: no messages on {topic}")
        content = file.decoder(first[topic].channel_id)(first[topic].data)
        # Those with names may be sent by another publisher.
        plain = [each for each in fields[topic] if not each.wanted]
        _values(content, plain, f"{source} at {first[topic].log_time} ns")


def _fields(mapping: ImportMapping) -> dict[str, list[MessageField]]:
    """Return the fields of each topic."""
    fields: dict[str, list[MessageField]] = {}
    for name in mapping.all_fields:
        of_message = MessageField(name)
        fields.setdefault(of_message.topic, []).append(of_message)
    return fields


def _by_publisher(
    file: McapFile, mapping: ImportMapping, fields: dict[str, list[MessageField]]
) -> tuple[ImportMapping, dict[str, list[MessageField]]]:
    """Treat what several publishers send to one topic, each its own joints, as topics of their own.

    They are called by the topic and the joints. Returns the mapping and the fields of each.
    """
    named = {topic for topic, each in fields.items() if any(field.wanted for field in each)}
    sent: dict[str, set[frozenset[str]]] = {topic: set() for topic in named}
    for topic, message in file.messages(checked=False) if named else ():
        if topic in named:
            sent[topic].add(_sent(file, fields[topic], message))
    streams: dict[str, str] = {}
    split: dict[str, list[MessageField]] = {
        topic: each for topic, each in fields.items() if topic not in named
    }
    for topic, groups in sent.items():
        wanted = {field.wanted for field in fields[topic] if field.wanted}
        if len(groups) < 2 or not wanted <= set().union(*groups):
            split[topic] = fields[topic]  # of one publisher, or without what is wanted
            continue
        is_apart = sum(map(len, groups)) == len(wanted)
        of = {n: f"{topic}[{','.join(sorted(group)) if is_apart else n}]" for group in groups for n in group}
        for each in fields[topic]:
            stream = of.get(each.wanted) or min(of.values())
            split.setdefault(stream, []).append(each)
            streams[each.name] = stream + each.name.removeprefix(topic)
        file.streams[topic] = partial(_streams, file, fields[topic], of)
    return mapping.renamed(streams), split


def _sent(file: McapFile, fields: Sequence[MessageField], message: Any) -> frozenset[str]:  # noqa: ANN401
    """Return which of the names that `fields` want are in a message of theirs."""
    content = file.decoder(message.channel_id)(message.data)
    return frozenset(field.wanted for field in fields if field.wanted in field.names_in(content))


def _streams(
    file: McapFile,
    fields: Sequence[MessageField],
    of: Mapping[str, str],
    message: Any,  # noqa: ANN401 - of mcap
) -> list[str]:
    """Return as what topics a message counts."""
    return sorted({of[name] for name in _sent(file, fields, message)})


def _rows(
    source: Source, resampler: Resampler, timeline: Timeline, fields: Mapping[str, list[MessageField]]
) -> Iterator[tuple[bool, bool, dict[str, Array], dict[str, int]]]:
    """Yield whether a row begins an episode, and since time goes back, its values and the topics' times."""
    time = 0
    is_back = False
    log_times: dict[str, int] = {}
    sizes: dict[str, tuple[int, ...]] = {}
    for topic, time, log_time, content, begins_back in timeline.messages():
        values = _values(content, fields[topic], f"{source} at {log_time} ns")
        changed = [name for name, v in values.items() if sizes.setdefault(name, v.shape) != v.shape]
        if changed:
            raise BadInputError(f"{source} at {log_time} ns: {', '.join(changed)} changes in size")
        for begins, row in resampler.rows_before(time):
            yield begins, begins and is_back, row, dict(log_times)
            is_back &= not begins
        is_back |= begins_back
        log_times[topic] = log_time
        resampler.receive(topic, time, values)
    for begins, row in resampler.last_rows(time):
        yield begins, begins and is_back, row, dict(log_times)
        is_back &= not begins
    silent = sorted(resampler.topics.keys() - resampler.times.keys())
    if silent:
        raise BadInputError(f"{source}: no messages on {', '.join(silent)}")
    for silence in resampler.endings():
        _log.warning("%s", silence)


def _block(source: Source, rows: _Rows, known: list[str], topic_of: Mapping[str, str]) -> Block:
    values = {name: np.stack([row[name] for row in rows.values]) for name in rows.values[0]}
    places = {
        row: f"{source} at {rows.times[row][topic_of[name]]} ns"
        for name, column in reversed(values.items())
        if column.dtype.kind == "f"
        for row in np.flatnonzero(~np.isfinite(column.reshape(len(column), -1)).all(axis=1)).tolist()
    }
    return Block(values, str(source), rows.starts, is_back=rows.is_back, places=places, known=known)


def _check_mapping(mapping: ImportMapping, origin: str) -> None:
    faults = [
        f"field '{name}', expected '/topic:path.in.message'"
        for name in mapping.all_fields
        if not all(name.partition(":"))
    ]
    if mapping.split.gap_s is None:
        faults.append("split.gap_s is missing: the longest time for which a topic's last value is held")
    if mapping.time is not None:
        faults.append("time: leave it out, the messages' log times are used")
    if all(column.latched for column in mapping.columns.values()):
        faults.append("every column is latched, expected one that is not")
    if faults:
        raise BadInputError(f"{origin}: {'; '.join(faults)}")


def _values(content: Any, fields: Sequence[MessageField], origin: str) -> Mapping[str, Array]:  # noqa: ANN401 - any message
    values, faults = {}, []
    for each in fields:
        try:
            values[each.name] = each.value(content)
        except BadInputError as error:
            faults.append(str(error))
    if faults:
        raise BadInputError(f"{origin}: {'; '.join(faults)}")
    return values
