import re
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_recordings import Message, command, ns, pose, write_json

from astra_data.core.errors import BadInputError
from astra_data.io.importers.mcap import McapFile, Timeline
from astra_data.io.recording import Source

CHUNK = 2000
LENGTH = 300


def write(path: Path, *, is_finished: bool = True, **options: Any) -> Path:
    """Write messages of one topic, and some of another, whose contents end in zeros."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=CHUNK, **options)
        writer.start()
        used = writer.register_channel("/used", "json", schema_id=0)
        other = writer.register_channel("/other", "json", schema_id=0)
        for number in range(LENGTH):
            channel = other if number % 5 == 0 or 100 < number < 200 else used
            writer.add_message(channel, number, b"%03d" % number + bytes(20), number)
        if is_finished:
            writer.finish()  # type: ignore[no-untyped-call]
    return path


def numbers(path: Path) -> tuple[list[int], bool]:
    """Return which messages are read, and whether the file is cut off."""
    file = McapFile(Source(path, None, path), ["/used"])
    read = [message.log_time for _, message in file.messages()]
    file.check_topics()
    return read, file.is_cut


WANTED = [number for number in range(LENGTH) if number % 5 and not 100 < number < 200]
FORMS: dict[str, dict[str, Any]] = {"usual": {}, "without chunks": {"use_chunking": False}}


PACKED = [CompressionType.ZSTD, CompressionType.LZ4]


@pytest.mark.parametrize("compression", PACKED)
def test_no_more_is_unpacked_than_the_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compression: CompressionType
) -> None:
    path = write(tmp_path / "log.mcap", compression=compression)
    unpacked = 300 * (22 + 9 + 23)  # of a message: what stands before it, and its content
    monkeypatch.setattr("astra_data.io.recording.MOST_UNPACKED", 0)
    for limit, is_read in ((unpacked + 1000, True), (unpacked - 5000, False)):
        monkeypatch.setattr("astra_data.io.recording.SMALL_BYTES", limit)
        file = McapFile(Source(path, None, path, most_bytes=0), ["/used", "/other"])
        if is_read:
            assert len(list(file.messages())) == LENGTH
            continue
        with pytest.raises(BadInputError, match=r"once unpacked: if you trust it, pass a larger --max-bytes"):
            list(file.messages())


@pytest.mark.parametrize("compression", PACKED)
@pytest.mark.parametrize("declared", [0, 100, 10**6])
def test_a_chunk_is_unpacked_as_far_as_it_says(tmp_path: Path, compression: CompressionType, declared: int) -> None:
    path = write(tmp_path / "log.mcap", compression=compression)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    content = bytearray(path.read_bytes())
    start = summary.chunk_indexes[0].chunk_start_offset + 9 + 16
    content[start : start + 8] = struct.pack("<Q", declared)
    path.write_bytes(content)
    with pytest.raises(BadInputError, match="has another size than its header says"):
        numbers(path)


def test_the_index_tells_of_missing_topics_before_anything_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "log.mcap")
    with pytest.raises(BadInputError, match=r"^log\.mcap: no topic '/use': did you mean '/used'\?$"):
        McapFile(Source(path, None, path), ["/use"])


@pytest.mark.parametrize("form", ["usual", "without chunks"])
@pytest.mark.parametrize("zeros", [0, 9, 70_000])
def test_a_file_that_is_cut_off_is_read_up_to_there(tmp_path: Path, form: str, zeros: int) -> None:
    whole = write(tmp_path / "whole.mcap", **FORMS[form]).read_bytes()
    path = tmp_path / "log.mcap"
    lengths = set()
    for cut in range(200, len(whole) - 1, 397):
        path.write_bytes(whole[:cut] + bytes(zeros))
        try:
            read, is_cut = numbers(path)
        except BadInputError as error:
            assert re.search("no topic '/used'|is cut off before its first message ends", str(error))
            read, is_cut = [], True
        assert read == WANTED[: len(read)]
        assert is_cut or read == WANTED
        lengths.add(len(read))
    assert len(lengths) > 5 and max(lengths) == len(WANTED)


def test_a_recorder_that_was_killed_leaves_whole_chunks(tmp_path: Path) -> None:
    read, is_cut = numbers(write(tmp_path / "log.mcap", is_finished=False))
    assert is_cut and 0 < len(read) < len(WANTED) and read == WANTED[: len(read)]


def test_damage_before_a_cut_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "log.mcap", compression=CompressionType.NONE)
    content = bytearray(path.read_bytes())
    content[content.index(b"050" + bytes(20))] ^= 1
    path.write_bytes(content[: 3 * len(content) // 4])
    with pytest.raises(ValueError, match="crc validation failed in Chunk"):
        numbers(path)


@pytest.mark.parametrize("content", [b"", bytes(100)])
def test_an_empty_file_is_told(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    with pytest.raises(BadInputError, match=r"^log\.mcap is empty: nothing was recorded, leave it out$"):
        numbers(path)


def test_a_file_that_was_only_begun_is_told(tmp_path: Path) -> None:
    path = write(tmp_path / "log.mcap")
    for size in (3, 8, 20):
        path.write_bytes(write(tmp_path / "whole.mcap").read_bytes()[:size])
        with pytest.raises(BadInputError, match=r"^log\.mcap is cut off before its first message ends"):
            numbers(path)


def test_an_encoding_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Twist", "ros1msg", b"float64 x")
        used = writer.register_channel("/used", "ros1", schema)
        writer.add_message(used, 0, bytes(8), 0)
        writer.finish()  # type: ignore[no-untyped-call]
    file_of = McapFile(Source(path, None, path), ["/used"])
    [(_, message)] = file_of.messages()
    with pytest.raises(BadInputError, match="messages of /used are ros1 with ros1msg schema, expected json"):
        file_of.decoder(message.channel_id)


GAP_S = 0.5
PAUSE_S = 0.7


def timeline(path: Path, messages: Iterable[Message]) -> Timeline:
    write_json(path, messages)
    return Timeline(McapFile(Source(path, None, path), ["/pose", "/command"]), GAP_S, PAUSE_S)


def drive(begin: float, end: float) -> list[Message]:
    """Poses at 20 Hz, commands at 10 Hz, numbered by their times."""
    messages = [pose(k / 20, k / 20) for k in range(round(20 * begin), round(20 * end))]
    messages += [command(k / 10 + 0.01, k / 10) for k in range(round(10 * begin), round(10 * end))]
    return sorted(messages, key=lambda message: message[1])


McapMessage = tuple[str, int, int, Any]


def log_times(messages: Iterable[McapMessage]) -> list[int]:
    return [log_time for _, _, log_time, *_ in messages]


def check(read: Timeline) -> list[McapMessage]:
    """Compare the times of messages with the moments, and return the messages."""
    messages = list(read.messages())
    times = [time for _, time, *_ in messages]
    assert times == sorted(times) and read.moments.keys() == {"/pose", "/command"}
    for topic, moments in read.moments.items():
        assert moments.tolist() == [time for of, time, *_ in messages if of == topic]
    return messages


@pytest.mark.parametrize("mixed", ["in order", "in windows", "by topic", "wholly"])
def test_messages_come_in_the_order_of_their_times(tmp_path: Path, mixed: str) -> None:
    ordered = drive(0, 10)
    rng = np.random.default_rng(0)
    keys = {
        "in order": np.arange(len(ordered)),
        "in windows": np.arange(len(ordered)) + rng.uniform(0, 10, len(ordered)),
        "by topic": np.array([(time // 3, topic == "/pose") for topic, time, _ in ordered]) @ [2, 1],
        "wholly": rng.permutation(len(ordered)),
    }
    order = np.argsort(keys[mixed], kind="stable")
    messages = check(timeline(tmp_path / "log.mcap", [ordered[at] for at in order]))
    assert log_times(messages) == [ns(time) for _, time, _ in ordered]
    assert all(time == log_time for _, time, log_time, _ in messages)


@pytest.mark.parametrize("step_s", [0.6, 2.0, 100.0])
def test_a_clock_that_is_set_back_begins_anew(tmp_path: Path, step_s: float) -> None:
    before, after = drive(100, 105), drive(105, 110)
    set_back = [(topic, time - step_s, content) for topic, time, content in after]
    messages = check(timeline(tmp_path / "log.mcap", before + set_back))
    assert log_times(messages) == [ns(time) for _, time, _ in before + set_back]
    pause_ns = messages[len(before)][1] - messages[len(before) - 1][1]
    assert pause_ns > ns(PAUSE_S)


def test_no_more_is_held_than_may_be_out_of_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each message is asked for when those before it, but for the last few, were given."""
    ordered = drive(0, 10)
    swapped = [message for pair in zip(ordered[1::2], ordered[::2], strict=True) for message in pair]
    read = timeline(tmp_path / "log.mcap", swapped)
    asked = 0
    messages = McapFile.messages

    def counted(self: McapFile) -> Iterable[object]:
        nonlocal asked
        for message in messages(self):
            asked += 1
            yield message

    monkeypatch.setattr(McapFile, "messages", counted)
    for given, _ in enumerate(read.messages()):
        assert asked - given <= 4


def test_the_sum_of_the_whole_file_is_compared(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False, enable_data_crcs=True)
        writer.start()
        for topic in ("/pose", "/command"):
            channel = writer.register_channel(topic, "json", schema_id=0)
            writer.add_message(channel, 0, b'{"turn": 0.125}', 0)
        writer.finish()  # type: ignore[no-untyped-call]
    path.write_bytes(path.read_bytes().replace(b"0.125", b"0.135", 1))
    with pytest.raises(ValueError, match="crc validation failed in DataEnd"):
        Timeline(McapFile(Source(path, None, path), ["/pose", "/command"]), GAP_S, PAUSE_S)
