from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from mcap_recordings import Message, command, ns, pose, write_json

from astra_data.exchange.mcap_file import McapFile
from astra_data.exchange.mcap_timeline import McapMessage, Timeline
from astra_data.exchange.recording import Source

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


def log_times(messages: Iterable[McapMessage]) -> list[int]:
    return [message.log_time for message in messages]


def check(read: Timeline) -> list[McapMessage]:
    """Compare the times of messages with the moments, and return the messages."""
    messages = list(read.messages())
    times = [message.time for message in messages]
    assert times == sorted(times)
    assert read.moments.keys() == {"/pose", "/command"}
    for topic, moments in read.moments.items():
        assert moments.tolist() == [message.time for message in messages if message.topic == topic]
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
    assert all(message.time == message.log_time and not message.is_back for message in messages)


def test_equal_times_keep_the_order_of_the_file(tmp_path: Path) -> None:
    messages = [pose(1.0, 0), command(1.0, 1), pose(1.0, 2), command(0.9, 3), pose(1.0, 4), pose(1.2, 5)]
    contents = [message.content for message in check(timeline(tmp_path / "log.mcap", messages))]
    values = [content["turn"] if "turn" in content else content["position"]["x"] for content in contents]
    assert values == [3, 0, 1, 2, 4, 5]


@pytest.mark.parametrize("step_s", [0.6, 2.0, 100.0])
def test_a_clock_that_is_set_back_begins_anew(tmp_path: Path, step_s: float) -> None:
    before, after = drive(100, 105), drive(105, 110)
    set_back = [(topic, time - step_s, content) for topic, time, content in after]
    messages = check(timeline(tmp_path / "log.mcap", before + set_back))
    assert log_times(messages) == [ns(time) for _, time, _ in before + set_back]
    assert [at for at, message in enumerate(messages) if message.is_back] == [len(before)]
    pause_ns = messages[len(before)].time - messages[len(before) - 1].time
    assert pause_ns > ns(PAUSE_S)


def test_a_clock_may_be_set_back_again_and_again(tmp_path: Path) -> None:
    messages = check(timeline(tmp_path / "log.mcap", drive(10, 13) + drive(10, 13) + drive(5, 8)))
    assert [at for at, message in enumerate(messages) if message.is_back] == [90, 180]


def test_a_little_back_and_far_ahead_is_no_new_beginning(tmp_path: Path) -> None:
    ahead = [(topic, time + 3600, content) for topic, time, content in drive(4, 8)]
    back = [(topic, time - 0.4, content) for topic, time, content in drive(8, 12)]
    messages = check(timeline(tmp_path / "log.mcap", drive(0, 4) + ahead))
    assert not any(message.is_back for message in messages)
    messages = check(timeline(tmp_path / "log.mcap", drive(4, 8) + back))
    assert not any(message.is_back for message in messages)
    assert log_times(messages) == sorted(log_times(messages))


def test_no_more_is_held_than_may_be_out_of_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each message is asked for when those before it, but for the last few, were given."""
    ordered = drive(0, 10)
    swapped = [message for pair in zip(ordered[1::2], ordered[::2], strict=True) for message in pair]
    read = timeline(tmp_path / "log.mcap", swapped)
    asked = 0
    messages = McapFile.messages

    def counted(self: McapFile, *, checked: bool) -> Iterable[object]:
        nonlocal asked
        for message in messages(self, checked=checked):
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
    read = Timeline(McapFile(Source(path, None, path), ["/pose", "/command"]), GAP_S, PAUSE_S)
    with pytest.raises(ValueError, match="crc validation failed in DataEnd"):
        list(read.messages())
