from pathlib import Path

from fake_dataset import COLUMNS, DESCRIPTION, fake_columns, fake_episode, write_fake, writer

from astra_data.dataset.columns import STATE, Column, Episode
from astra_data.dataset.compare import Differences, differences
from astra_data.dataset.reader import Dataset


def test_equal_datasets_do_not_differ(tmp_path: Path) -> None:
    found = differences(write_fake(tmp_path / "a"), write_fake(tmp_path / "b"))
    assert found == Differences(schema=[], only_in_a=[], only_in_b=[], values=[], metadata={}, description=[])


def test_every_kind_of_difference_is_told(tmp_path: Path) -> None:
    a = write_fake(tmp_path / "a")
    columns = [*COLUMNS[:-1], Column("other", "int64")]
    changed = dict(DESCRIPTION) | {"config": {"episodes": 5, "noise_m": 0.2}, "version": "1.1.0"}
    with writer(tmp_path / "b", columns=columns, fps=10, description=changed) as open_writer:
        for uid, length in ((13, 7), (4, 1), (6, 30), (99, 3)):
            values = dict(fake_columns(length, seed=uid))
            values["other"] = values.pop("mode")
            if uid == 6:
                values[STATE] = values[STATE] + 1
            metadata = dict(fake_episode(uid, length).metadata) | ({"return": 9.0} if uid == 4 else {})
            open_writer.add(Episode(uid, values, metadata))
    found = differences(a, Dataset.open(tmp_path / "b"))
    assert found.schema == [
        "column mode: only in fake@data-1.0.0",
        "column other: only in fake@data-1.1.0",
        "fps: 20, then 10",
    ]
    assert (found.only_in_a, found.only_in_b) == ([0, 2**53 + 1], [99])
    assert (found.values, found.metadata) == ([6], {"return": [4]})
    assert found.description == ["version: '1.0.0', then '1.1.0'", "config.noise_m: 0.1, then 0.2"]


def test_long_lists_of_the_provenance_are_counted(tmp_path: Path) -> None:
    def made(name: str, recordings: list[str]) -> Dataset:
        description = dict(DESCRIPTION) | {"config": {"recordings": recordings}}
        with writer(tmp_path / name, description=description) as open_writer:
            open_writer.add(fake_episode(4, 1))
        return Dataset.open(tmp_path / name)

    logs = [f"{number}.csv" for number in range(60)]
    long = made("long", logs)
    for recordings, told in (
        (["other.csv", *logs[1:]], "60 entries, then 60 entries, 1 of them new"),
        (logs[:2], "60 entries, then ['0.csv', '1.csv']"),
        (logs[:5], "60 entries, then ['0.csv', '1.csv', '2.csv', '3.csv', '4.csv']"),
        (logs[:6], "60 entries, then 6 entries, 0 of them new"),
    ):
        other = made(str(len(recordings)), recordings)
        assert differences(long, other).description == [f"config.recordings: {told}"]
