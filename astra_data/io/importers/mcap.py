"""MCAP: messages of asynchronous topics, as JSON, protobuf or ROS 2 (CDR), resampled to fps.

Times are the messages' log times. Files are read message by message, twice: how often topics come decides
when rows are taken (`io/resampling.py`).
"""

import json
import logging
import re
import struct
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from io import SEEK_END
from mmap import ACCESS_READ, mmap
from typing import IO, Any

import numpy as np

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError, optional
from astra_data.dataset.columns import Array
from astra_data.io.mapping import ImportMapping
from astra_data.io.recording import MOST_UNPACKED, VALUE_BYTES, Block, Source
from astra_data.io.resampling import Resampler

MAGIC = b"\x89MCAP0\r\n"
_BLOCK_BYTES = 2**16
FEWEST = 10  # messages to a step back of the clock


class McapFile:
    """The messages of some topics of an MCAP file, in its order."""

    def __init__(self, source: Source, topics: Collection[str]) -> None:
        """Look at both ends of the file, and at its index if it has one."""
        self.streams: dict[str, Callable[[Any], list[str]]] = {}
        """Topic to what gives the names under which one of its messages is yielded, by default its own."""
        self._decoders: dict[int, Callable[[bytes], Any]] = {}
        self._source, self._wanted = source, topics
        self._channels: dict[int, Any] = {}
        self._schemas: dict[int, Any] = {}
        with source.open() as stream:
            size, self._content_bytes = stream.seek(0, SEEK_END), _content_bytes(stream)
            if not self._content_bytes:
                raise BadInputError(f"{source} is empty: nothing was recorded, leave it out")
            stream.seek(max(size - len(MAGIC), 0))
            self.is_cut = size < 2 * len(MAGIC) or stream.read() != MAGIC  # messages may be missing at its end
            stream.seek(0)
            summary = None if self.is_cut else optional("mcap.reader").make_reader(stream).get_summary()
        # An index may leave out what the data say.
        if summary and summary.statistics and summary.statistics.channel_count == len(summary.channels):
            self._channels = dict(summary.channels)
            self.check_topics()

    def messages(self) -> Iterator[tuple[str, Any]]:
        """Yield each message with its topic, in the order of the file."""
        records = optional("mcap.records")
        for record in self._records():
            if isinstance(record, records.Message):
                if record.channel_id not in self._channels:
                    raise BadInputError(f"{self._source}: no channel {record.channel_id}, which has messages")
                topic = self._channels[record.channel_id].topic
                if topic in self._wanted:
                    for stream in self.streams[topic](record) if topic in self.streams else [topic]:
                        yield stream, record
            elif isinstance(record, records.Channel):
                self._channels[record.id] = record
            elif isinstance(record, records.Schema):
                self._schemas[record.id] = record

    @property
    def topics(self) -> set[str]:
        """The topics that the file's index or its messages have named so far."""
        return {channel.topic for channel in self._channels.values()}

    def check_topics(self) -> None:
        """Raise BadInputError if wanted topics are missing, once the index or the messages were read."""
        known = sorted(self.topics)
        if self.is_cut and not known:
            raise BadInputError(f"{self._source} is cut off before its first message ends: leave it out")
        if missing := [f"no topic '{t}'{did_you_mean(t, known)}" for t in self._wanted if t not in known]:
            raise BadInputError(f"{self._source}: {'; '.join(missing)}")

    def decoder(self, number: int) -> Callable[[bytes], Any]:
        """Return the decoder of the messages of channel `number`, or raise BadInputError."""
        if number in self._decoders:
            return self._decoders[number]
        channel = self._channels[number]
        schema = self._schemas.get(channel.schema_id)
        for package in ("mcap_protobuf", "mcap_ros2"):
            factory = optional(f"{package}.decoder").DecoderFactory()
            if decoder := factory.decoder_for(channel.message_encoding, schema):
                return self._decoders.setdefault(number, decoder)
        if channel.message_encoding == "json":
            return self._decoders.setdefault(number, json.loads)
        encoding = f"{channel.message_encoding} with {schema.encoding if schema else 'no'} schema"
        expected = "expected json, protobuf, or cdr with ros2msg schema"
        raise BadInputError(f"{self._source}: messages of {channel.topic} are {encoding}, {expected}")

    def _records(self) -> Iterator[Any]:
        """Yield the records of the data, those of chunks unpacked, up to where the file is cut off."""
        reading, records = optional("mcap.stream_reader"), optional("mcap.records")
        left = self._source.most_unpacked
        with self._source.open() as file, mmap(file.fileno(), self._content_bytes, access=ACCESS_READ) as stream:
            try:
                for record in reading.StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
                    if isinstance(record, records.DataEnd):
                        self.is_cut = False
                        return
                    if not isinstance(record, records.Chunk):
                        yield record
                        continue
                    left -= record.uncompressed_size
                    if left < 0:
                        raise BadInputError(
                            f"{self._source}: its chunks are more than {MOST_UNPACKED} times as large as the file "
                            "once unpacked: if you trust it, pass a larger --max-bytes"
                        )
                    yield from reading.breakup_chunk(self._unpacked(record), validate_crc=True)
            except (optional("mcap.exceptions").EndOfFile, struct.error):
                if not self.is_cut:
                    raise

    def _unpacked(self, chunk: Any) -> Any:
        """Return a chunk unpacked as far as its header says, which the library does not hold to."""
        data, most = chunk.data, chunk.uncompressed_size + 1
        if chunk.compression == "zstd":
            data = optional("zstandard").ZstdDecompressor().stream_reader(data, read_across_frames=True).read(most)
        elif chunk.compression == "lz4":
            data = optional("lz4.frame").LZ4FrameDecompressor().decompress(data, max_length=most)
        elif chunk.compression:
            raise BadInputError(f"{self._source}: chunks packed as {chunk.compression}, expected zstd or lz4")
        if len(data) != chunk.uncompressed_size:
            raise BadInputError(f"{self._source}: a chunk has another size than its header says: it is damaged")
        return replace(chunk, compression="", data=data)


def _content_bytes(stream: IO[bytes]) -> int:
    """Return the size of a file without the zeros at its end, which a full or failing disk leaves."""
    end = stream.seek(0, SEEK_END)
    while end:
        begin = max(0, end - _BLOCK_BYTES)
        stream.seek(begin)
        if content := stream.read(end - begin).rstrip(b"\0"):
            return begin + len(content)
        end = begin
    return 0


class Timeline:
    """The messages of an MCAP file by their times."""

    def __init__(self, file: McapFile, gap_s: float, pause_s: float) -> None:
        """Find out when messages come, by reading the file once.

        A topic may go back by `gap_s` while the clock does not; `pause_s` between messages ends an episode in any case.
        """
        self._file = file
        times, topics, numbers = array("Q"), array("H"), dict[str, int]()
        starts, highest = [0], dict[str, int]()
        for topic, message in file.messages():
            if message.log_time < highest.get(topic, 0) - round(gap_s * 1e9):
                starts.append(len(times))
                highest = {}
            highest[topic] = max(message.log_time, highest.get(topic, 0))
            times.append(message.log_time)
            topics.append(numbers.setdefault(topic, len(numbers)))
        file.check_topics()
        if len(times) < FEWEST * (len(starts) - 1):
            starts = [0]
        self._times = np.array(times, np.int64)
        """As in the file, but that each stretch begins a pause after the one before."""
        for before, start, end in zip(starts, starts[1:], [*starts, len(times)][2:], strict=False):
            pause_ns = 2 * round(pause_s * 1e9) + 1
            shift = self._times[before:start].max() + pause_ns - self._times[start:end].min()
            self._times[start:end] += shift
        self._order = np.argsort(self._times, kind="stable").tolist()
        kinds = np.array(topics)
        self.moments = {topic: np.sort(self._times[kinds == number]) for topic, number in numbers.items()}
        """Topic to the times of its messages in ns, as `messages` yields them, in their order."""

    def messages(self) -> Iterator[tuple[str, int, int, Any]]:
        """Yield topic, time and log time in ns, and content, by times that only rise.

        Only those that are out of order are held in memory.
        """
        held: dict[int, tuple[str, Any]] = {}
        messages = enumerate(self._file.messages())
        for number in self._order:
            while number not in held:
                at, each = next(messages)
                held[at] = each
            topic, message = held.pop(number)
            content = self._file.decoder(message.channel_id)(message.data)
            yield topic, int(self._times[number]), message.log_time, content


SUFFIXES = (".mcap",)
Message = tuple[int, Mapping[str, Array]]  # time in ns, by the recorder's clock, and values of fields
_MISSING = object()
_NAMES = "name"  # the part of a message that names the values of the lists beside it, as of joints in ROS

_log = logging.getLogger(__name__)


class MessageField:
    """What a field takes of each message: `/topic:path.in.message`, or `/topic:path.in.message[name]`."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.topic, _, path = name.partition(":")
        named = re.fullmatch(r"(.+?)\[(.+)\]", path)
        self._keys = (named[1] if named else path).split(".")
        self.wanted = named[2] if named else ""  # of the names beside a list
        self._names: list[str] | None = None

    def names_in(self, content: Any) -> list[str]:
        """Return the names of the values in a message; empty if it has none."""
        for key in self._keys[:-1]:
            content = _part(content, key)
        return _names_in(content) or []

    def value(self, content: Any) -> Array:
        """Return the numbers, or the text, in a message; a time in s and ns as whole ns."""
        before = owner = None
        part = content
        for depth, key in enumerate(self._keys):
            before, owner, part = owner, part, _part(part, key)
            if part is _MISSING:
                raise BadInputError(self._lacks(owner, depth))
        if self.wanted:
            part = self._named(owner, part)
        elif _is_list(part):
            self._check_order(owner, part)
        elif _is_list(owner):
            self._check_order(before, owner)
        value = np.array(list(part) if _is_list(part) else part)
        if value.dtype.kind in "biufU":
            return value
        if sorted(_parts(part)) == ["nanosec", "sec"]:
            return np.array(_part(part, "sec") * 10**9 + _part(part, "nanosec"))
        raise BadInputError(f"'{self.name}' is neither a number nor a list of numbers")

    def _lacks(self, owner: Any, depth: int) -> str:
        key, where = self._keys[depth], self._path(depth)
        if _is_list(owner):
            return f"no part '{key}' in {where}, which has {len(owner)} values, counted from 0"
        parts = _parts(owner)
        known = f", which has {', '.join(parts)}" if parts else ""
        return f"no part '{key}' in {where}{known}{did_you_mean(key, parts).partition('; known')[0]}"

    def _path(self, depth: int) -> str:
        return ":".join(filter(None, (self.topic, ".".join(self._keys[:depth]))))

    def _named(self, owner: Any, values: Any) -> Any:
        """Return the one of `values` that the list of names beside them calls as is wanted."""
        where, names = self._path(len(self._keys)), _names_in(owner)
        if names is None or not _is_list(values):
            raise BadInputError(f"'{self.name}': {where} is no list with a list '{_NAMES}' beside it")
        if self.wanted not in names:
            raise BadInputError(f"no '{self.wanted}' in {where}{did_you_mean(self.wanted, names)}")
        if len(values) != len(names):
            raise BadInputError(f"{where} has {len(values)} values for {len(names)} names")
        return values[names.index(self.wanted)]

    def _check_order(self, owner: Any, values: Any) -> None:
        names = _names_in(owner)
        if names is None or len(names) != len(values) or names == self._names or self._keys[-1] == _NAMES:
            return
        if self._names is not None:
            by_name = self.name.removesuffix(f".{self._keys[-1]}" if self._keys[-1].isdecimal() else "")
            advice = f"take each value by its name, '{by_name}[{self._names[0]}]'"
            order = f"its names are {', '.join(names)}, and were {', '.join(self._names)}"
            raise BadInputError(f"'{self.name}' is in another order than before: {order}; {advice}")
        self._names = names


Fields = dict[str, list[MessageField]]  # topic to what is taken of its messages


def check(source: Source, mapping: ImportMapping) -> None:
    """Raise BadInputError where the index of a file lacks topics."""
    McapFile(source, {name.partition(":")[0] for name in mapping.all_fields})


def read(source: Source, mapping: ImportMapping) -> Iterator[Block]:
    """Yield rows at the rate `mapping.fps`."""
    _check_mapping(mapping, str(source))
    by_topic: Fields = {}
    for each in map(MessageField, mapping.all_fields):
        by_topic.setdefault(each.topic, []).append(each)
    file = McapFile(source, by_topic.keys())
    fields = _by_publisher(file, by_topic)
    gaps_s = [mapping.split.gap_s or 0, *(column.gap_s or 0 for column in mapping.columns.values())]
    timeline = Timeline(file, gaps_s[0], max(gaps_s))
    topic_of = {field.name: topic for topic, each in fields.items() for field in each}
    resampler = Resampler(mapping, str(source), timeline.moments, topic_of)
    known = sorted(file.topics - by_topic.keys())
    rows: dict[str, list[Message]] = {topic: [] for topic in fields}
    first = count = 0
    for begins, row in resampler.rows(_messages(source, timeline, fields)):
        if begins and count > first:
            yield replace(_block(source, rows, fields), row=first, known=known)
            rows, first = {topic: [] for topic in fields}, count
        for topic, message in row.items():
            rows[topic].append(message)
        count += 1
        source.refuse_beyond(count * VALUE_BYTES * len(mapping.all_fields))
    if silent := sorted(resampler.topics.keys() - resampler.times.keys()):
        raise BadInputError(f"{source}: no messages on {', '.join(silent)}")
    for silence in resampler.endings():
        _log.warning("%s", silence)
    if count > first:
        block = replace(_block(source, rows, fields), row=first, known=known)
        yield replace(block, torn=file.is_cut, notes=resampler.unevenness())


def _by_publisher(file: McapFile, fields: Fields) -> Fields:
    """Treat what several publishers send to one topic, each its own joints, as topics of their own, named by both."""
    named = {topic for topic, each in fields.items() if any(field.wanted for field in each)}
    sent: dict[str, set[frozenset[str]]] = {topic: set() for topic in named}
    for topic, message in file.messages() if named else ():
        if topic in named:
            sent[topic].add(_sent(file, fields[topic], message))
    split = {topic: each for topic, each in fields.items() if topic not in named}
    for topic, groups in sent.items():
        wanted = {field.wanted for field in fields[topic] if field.wanted}
        if len(groups) < 2 or not wanted <= set().union(*groups):
            split[topic] = fields[topic]  # of one publisher, or without what is wanted
            continue
        is_apart = sum(map(len, groups)) == len(wanted)
        of = {n: f"{topic}[{','.join(sorted(group)) if is_apart else n}]" for group in groups for n in group}
        for each in fields[topic]:
            split.setdefault(of.get(each.wanted) or min(of.values()), []).append(each)
        file.streams[topic] = partial(_streams, file, fields[topic], of)
    return split


def _sent(file: McapFile, fields: Sequence[MessageField], message: Any) -> frozenset[str]:
    """Return which of the names that `fields` want are in a message of theirs."""
    content = file.decoder(message.channel_id)(message.data)
    return frozenset(field.wanted for field in fields if field.wanted in field.names_in(content))


def _streams(file: McapFile, fields: Sequence[MessageField], of: dict[str, str], message: Any) -> list[str]:
    return sorted({of[name] for name in _sent(file, fields, message)})


def _messages(source: Source, timeline: Timeline, fields: Fields) -> Iterator[tuple[str, int, Message]]:
    sizes: dict[str, tuple[int, ...]] = {}
    for topic, time, log_time, content in timeline.messages():
        values, faults = dict[str, Array](), list[str]()
        for each in fields[topic]:
            try:
                values[each.name] = each.value(content)
            except BadInputError as error:
                faults.append(str(error))
        changed = [name for name, v in values.items() if sizes.setdefault(name, v.shape) != v.shape]
        faults += [f"{', '.join(changed)} changes in size"] if changed else []
        if faults:
            raise BadInputError(f"{source} at {log_time} ns: {'; '.join(faults)}")
        yield topic, time, (log_time, values)


def _block(source: Source, rows: Mapping[str, Sequence[Message]], fields: Fields) -> Block:
    """Return the rows of an episode, with each topic's messages; their times name what is not finite."""
    values, places = {}, dict[int, str]()
    for topic, messages in rows.items():
        for name in [field.name for field in fields[topic]]:
            values[name] = np.stack([message[name] for _, message in messages])
            if values[name].dtype.kind == "f":
                odd = np.flatnonzero(~np.isfinite(values[name].reshape(len(messages), -1)).all(axis=1)).tolist()
                places = {row: f"{source} at {messages[row][0]} ns" for row in odd} | places
    return Block(values, str(source), starts=True, places=places)


def _check_mapping(mapping: ImportMapping, origin: str) -> None:
    odd = [name for name in mapping.all_fields if not all(name.partition(":"))]
    faults = [f"field '{name}', expected '/topic:path.in.message'" for name in odd]
    if mapping.split.gap_s is None:
        faults.append("split.gap_s is missing: the longest time for which a topic's last value is held")
    if mapping.time is not None:
        faults.append("time: leave it out, the messages' log times are used")
    if all(column.latched for column in mapping.columns.values()):
        faults.append("every column is latched, expected one that is not")
    if faults:
        raise BadInputError(f"{origin}: {'; '.join(faults)}")


def _part(value: Any, key: str) -> Any:
    if isinstance(value, Mapping):
        return value.get(key, _MISSING)
    if key.isdecimal():
        return value[int(key)] if hasattr(value, "__len__") and int(key) < len(value) else _MISSING
    return getattr(value, key, _MISSING)


def _parts(value: Any) -> list[str]:
    """Return the names of the parts of a message, of JSON, protobuf or ROS 2."""
    if isinstance(value, Mapping):
        return list(value)
    if descriptor := getattr(value, "DESCRIPTOR", None):
        return [part.name for part in descriptor.fields]
    return list(getattr(value, "__slots__", ()))


def _is_list(value: Any) -> bool:
    return hasattr(value, "__len__") and not isinstance(value, str | Mapping)


def _names_in(owner: Any) -> list[str] | None:
    names = _part(owner, _NAMES)
    return list(names) if _is_list(names) and all(isinstance(name, str) for name in names) else None
