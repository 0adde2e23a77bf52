import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_recordings import MAPPING, command, log, ns, pose, write_json, write_protobuf, write_ros2
from recordings import imported

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, STATE


@pytest.mark.parametrize("write", [write_json, write_protobuf, write_ros2])
def test_the_last_value_is_held_at_every_row(tmp_path: Path, write: Any) -> None:  # noqa: ANN401
    messages = log()
    dataset, report = imported(tmp_path, write(tmp_path / "log.mcap", messages), MAPPING)
    poses = [(t, m["position"]["x"]) for topic, t, m in messages if topic == "/pose"]
    turns = [(t, m["turn"]) for topic, t, m in messages if topic == "/command"]
    assert len(dataset) == 2
    assert report.tally.split_points == {"source": 1}
    first, second = dataset.episodes()
    # From the first command to when the pose of 2 s may be held no longer, and from the pose of 3 s on.
    ends = ((0.13, 2.35), (3.0, 4.96))
    for episode, (start, end) in zip((first, second), ends, strict=True):
        ticks = [ns(start) + k * 10**8 for k in range(1000) if ns(start) + k * 10**8 <= ns(end)][:-1]
        x = [[v for t, v in poses if ns(t) <= tick][-1] for tick in ticks]
        expected = np.stack([x, np.add(x, 0.25), np.negative(x)], axis=1).astype(np.float32)
        np.testing.assert_array_equal(episode.columns[STATE], expected)
        turn = [[v for t, v in turns if ns(t) <= tick][-1] for tick in ticks]
        np.testing.assert_array_equal(episode.columns[ACTION], np.array(turn, np.float32))


def test_a_latched_topic_is_held_without_limit(tmp_path: Path) -> None:
    messages = [command(0.0, 7.0), *(pose(k / 10, k) for k in range(20))]
    path = write_json(tmp_path / "log.mcap", messages)
    latched = MAPPING.replace('fields = ["/command:turn"]', 'fields = ["/command:turn"]\nlatched = true')
    dataset, _ = imported(tmp_path, path, latched)
    np.testing.assert_array_equal(dataset.columns([ACTION])[ACTION], np.full(19, 7, np.float32))
    (tmp_path / "held").mkdir()
    held, _ = imported(tmp_path / "held", path, MAPPING)
    assert held.lengths.tolist() == [3]


def test_time_far_apart_costs_nothing(tmp_path: Path) -> None:
    messages = [
        m for t in (0.0, 1e9) for k in range(3) for m in (pose(t + k / 10, 1), command(t + k / 10, 1))
    ]
    dataset, _ = imported(tmp_path, write_json(tmp_path / "log.mcap", messages), MAPPING)
    assert dataset.lengths.tolist() == [5, 2]


def test_a_message_in_the_far_future_is_not_waited_for(tmp_path: Path) -> None:
    messages = [pose(0.0, 1), command(0.0, 1), pose(1.8e10, 2), command(1.8e10, 2)]
    mapping = MAPPING.replace("gap_s = 0.35", "gap_s = 1e10")
    with pytest.raises(BadInputError, match=r"log\.mcap: .* 100000000000 equal rows, .*split\.gap_s"):
        imported(tmp_path, write_json(tmp_path / "log.mcap", messages), mapping)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("/command:turn", "/comand:turn"), r"no topic '/comand': did you mean '/command'"),
        (("/command:turn", "/command:turns"), "'/command:turns' is neither a number"),
        (("/pose:joints", "/pose:position"), "'/pose:position' is neither a number"),
        (("/pose:joints", "joints"), "'joints', expected '/topic:path.in.message'"),
        (("gap_s = 0.35", ""), "split.gap_s is missing"),
        (("fps = 10", 'fps = 10\ntime = "/pose:t"'), "time: leave it out"),
    ],
)
def test_a_wrong_mapping_is_told(tmp_path: Path, change: tuple[str, str], told: str) -> None:
    path = write_json(tmp_path / "log.mcap", log())
    with pytest.raises(BadInputError, match=told):
        imported(tmp_path, path, MAPPING.replace(*change))
    assert not (tmp_path / "out").exists()


def test_messages_that_change_in_size_are_told(tmp_path: Path) -> None:
    messages = [command(0, 0), pose(0, 0), ("/pose", 0.1, {"position": {"x": 0}, "joints": [1.0]})]
    with pytest.raises(BadInputError, match="/pose:joints changes in size"):
        imported(tmp_path, write_json(tmp_path / "log.mcap", messages), MAPPING)


def test_a_missing_extra_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_json(tmp_path / "log.mcap", log())
    monkeypatch.setitem(sys.modules, "mcap_ros2.decoder", None)
    with pytest.raises(BadInputError, match=r'pip install "astra-data\[mcap\]"'):
        imported(tmp_path, path, MAPPING)
