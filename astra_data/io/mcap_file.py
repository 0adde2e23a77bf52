"""MCAP files: the messages of some topics, up to the last whole record of a file without an end.

A file is in the order in which its messages were recorded, but for a little: chunks and several publishers. Where a
topic goes back by more than `split.gap_s`, the clock was set back, and a new stretch begins for all topics, unless this
is so for over one in `FEWEST` messages: the file is out of order, and sorted.
"""

import json
import struct
from array import array
from collections.abc import Callable, Collection, Iterator
from io import SEEK_END, BytesIO
from mmap import ACCESS_READ, mmap
from typing import IO, Any, NamedTuple
from zlib import crc32

import numpy as np

from astra_data.core.config import did_you_mean
from astra_data.core.errors import BadInputError, optional
from astra_data.io.recording import MOST_UNPACKED, Source

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")  # of a record: its kind and its length
_BLOCK_BYTES = 2**16
FEWEST = 10  # messages to a step back of the clock


class McapFile:
    """The messages of some topics of an MCAP file, in its order."""

    def __init__(self, source: Source, topics: Collection[str]) -> None:
        """Look at both ends of the file, and read its index if it has one."""
        self.is_cut = False  # whether messages may be missing at its end; known once it was read
        self.streams: dict[str, Callable[[Any], list[str]]] = {}
        """Topic to what gives the names under which one of its messages is yielded, by default its own."""
        self._decoders: dict[int, Callable[[bytes], Any]] = {}
        self._source, self._wanted = source, topics
        self._channels: dict[int, Any] = {}
        self._schemas: dict[int, Any] = {}
        self._chunks: list[Any] | None = None
        self._whole_bytes: int | None = None
        self._left = 0
        self._open()

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

    def _open(self) -> None:
        with self._source.open() as stream:
            size, content = stream.seek(0, SEEK_END), _content_bytes(stream)
            if not content:
                raise BadInputError(f"{self._source} is empty: nothing was recorded, leave it out")
            stream.seek(max(size - len(MAGIC), 0))
            if size < 2 * len(MAGIC) or stream.read() != MAGIC:
                self._whole_bytes, self.is_cut = _whole_bytes(stream, content), True
                return
            stream.seek(0)
            summary = optional("mcap.reader").make_reader(stream).get_summary()
        if summary is None:
            return
        self._channels, self._schemas = dict(summary.channels), dict(summary.schemas)
        used = set().union(*(index.message_index_offsets for index in summary.chunk_indexes))
        described = {channel.schema_id for channel in summary.channels.values()} - {0}
        # A summary may leave out what the data say.
        if summary.chunk_indexes and used <= summary.channels.keys() and described <= summary.schemas.keys():
            indexes = sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
            wanted = {number for number, channel in self._channels.items() if channel.topic in self._wanted}
            # Some chunks list no channels.
            self._chunks = [index for index in indexes if not (of := index.message_index_offsets) or wanted & of.keys()]
            self.check_topics()

    def _records(self) -> Iterator[Any]:
        """Yield the records of the data, those of chunks unpacked."""
        reading, records = optional("mcap.stream_reader"), optional("mcap.records")
        with self._source.open() as stream:
            self._left = self._source.most_unpacked
            if self._chunks is not None:
                for index in self._chunks:
                    stream.seek(index.chunk_start_offset + _HEAD.size)
                    yield from self._unpacked(records.Chunk.read(reading.ReadDataStream(stream)))
                return
            whole: Any = stream
            if self._whole_bytes is not None:  # 0 would be the whole file
                whole = mmap(stream.fileno(), self._whole_bytes, access=ACCESS_READ) if self._whole_bytes else BytesIO()
            try:
                for record in reading.StreamReader(whole, emit_chunks=True, validate_crcs=True).records:
                    if isinstance(record, records.Chunk):
                        yield from self._unpacked(record)
                    elif isinstance(record, records.DataEnd):
                        self.is_cut = False
                        return
                    else:
                        yield record
            except optional("mcap.exceptions").EndOfFile:
                if self._whole_bytes is None:
                    raise

    def _unpacked(self, chunk: Any) -> Iterator[Any]:
        """Yield the records of a chunk, unpacked only as far as its header says and the limit allows."""
        reading, records = optional("mcap.stream_reader"), optional("mcap.records")
        if chunk.uncompressed_size > self._left:
            raise BadInputError(
                f"{self._source}: its chunks are more than {MOST_UNPACKED} times as large as the file once "
                "unpacked: if you trust it, pass a larger --max-bytes"
            )
        self._left -= chunk.uncompressed_size
        most = chunk.uncompressed_size + 1
        data: bytes = chunk.data
        if chunk.compression == "zstd":
            packed = optional("zstandard").ZstdDecompressor().stream_reader(data, read_across_frames=True)
            data = packed.read(most)
        elif chunk.compression == "lz4":
            data = optional("lz4.frame").LZ4FrameDecompressor().decompress(data, max_length=most)
        elif chunk.compression:
            raise BadInputError(f"{self._source}: chunks packed as {chunk.compression}, expected zstd or lz4")
        if len(data) != chunk.uncompressed_size:
            raise BadInputError(f"{self._source}: a chunk has another size than its header says: it is damaged")
        if chunk.uncompressed_crc and crc32(data) != chunk.uncompressed_crc:
            raise BadInputError(f"{self._source}: a chunk has another checksum than was written: it is damaged")
        stream, kinds = reading.ReadDataStream(BytesIO(data)), optional("mcap.opcode").Opcode
        while stream.count < len(data):
            kind, length = stream.read1(), stream.read8()
            if kind == kinds.MESSAGE:
                yield records.Message.read(stream, length)
            elif kind in (kinds.CHANNEL, kinds.SCHEMA):
                yield (records.Channel if kind == kinds.CHANNEL else records.Schema).read(stream)
            else:
                stream.read(length)


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


def _whole_bytes(stream: IO[bytes], content: int) -> int:
    """Return up to where the records of a file with `content` bytes before zeros are whole."""
    size = stream.seek(0, SEEK_END)
    end = len(MAGIC) if size >= len(MAGIC) else 0
    while True:
        stream.seek(end)
        head = stream.read(_HEAD.size)
        if len(head) < _HEAD.size:
            return end
        after = end + _HEAD.size + _HEAD.unpack(head)[1]
        # Without zeros at the end, a record may well end in some of its own.
        if after > content and after != size:
            return end
        end = after


class McapMessage(NamedTuple):
    """A message: its topic, its times in ns, and what it holds."""

    topic: str
    time: int  # on a clock that only goes forward
    log_time: int  # by the recorder's clock
    content: Any
    is_back: bool  # whether it is the first after the clock was set back


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
        self._firsts = {self._order[start] for start in starts[1:]}
        kinds = np.array(topics)
        self.moments = {topic: np.sort(self._times[kinds == number]) for topic, number in numbers.items()}
        """Topic to the times of its messages in ns, as `McapMessage.time`, in their order."""

    def messages(self) -> Iterator[McapMessage]:
        """Yield the messages, by their times, and in the file's order where these are equal.

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
            time = int(self._times[number])
            yield McapMessage(topic, time, message.log_time, content, number in self._firsts)
