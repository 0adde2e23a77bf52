from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from astra_data.dataset import plain
from astra_data.dataset.columns import EPISODE_INDEX, FRAME_INDEX, INDEX, TIMESTAMP, Array


def test_only_rows_of_numbers_are_plain_columns() -> None:
    features = {
        "state": {"dtype": "float64", "shape": [3]},
        "count": {"dtype": "uint8", "shape": (1,)},
        "image": {"dtype": "video", "shape": [3, 8, 8]},
        "text": {"dtype": "string", "shape": [1]},
        "empty": {"dtype": "float32", "shape": [0]},
        "true": {"dtype": "float32", "shape": [True]},
        "huge": {"dtype": "float32", "shape": [2**31]},
        "none": None,
        "shapeless": {"dtype": "float32"},
    }
    columns, others = plain.plain_columns(features)
    assert columns == [plain.PlainColumn("state", "float64", 3), plain.PlainColumn("count", "uint8", 1)]
    assert others == list(features)[2:]


def test_a_column_fits_lists_with_and_without_their_size() -> None:
    cases = [(3, pa.list_(pa.float32(), 3)), (3, pa.list_(pa.float32())), (1, pa.float32())]
    wrong = [(3, pa.list_(pa.float32(), 2)), (3, pa.list_(pa.float64())), (1, pa.list_(pa.float32()))]
    for size, kind in cases + wrong:
        faults = plain.schema_faults(pa.schema([("x", kind)]), [plain.PlainColumn("x", "float32", size)])
        assert len(faults) == ((size, kind) in wrong)


@pytest.mark.parametrize(
    ("table", "found"),
    [
        ({"task_index": [0, 2], "task": ["walk", "run"]}, {0: "walk", 2: "run"}),
        ({"task_index": [0], "__index_level_0__": ["walk"]}, {0: "walk"}),
        ({"task_index": [0, 0], "task": ["walk", "run"]}, "expected one text per task_index"),
        ({"task_index": [0, None], "task": ["walk", "run"]}, "expected one text per task_index"),
        ({"index": [0], "task": ["walk"]}, "expected task_index and one of texts"),
        ({"task_index": [0], "task": [1]}, "expected task_index and one of texts"),
        ({"task_index": [0], "task": ["walk"], "more": ["x"]}, "expected task_index and one of texts"),
    ],
)
def test_tasks_are_texts_by_their_index(tmp_path: Path, table: dict[str, list[object]], found: object) -> None:
    (tmp_path / "meta").mkdir()
    assert plain.read_tasks(tmp_path) == "is missing"
    pq.write_table(pa.table(table), tmp_path / "meta/tasks.parquet")
    read = plain.read_tasks(tmp_path)
    assert found in read if isinstance(found, str) and isinstance(read, str) else read == found


def test_rows_of_episodes_are_read_a_few_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "meta/episodes/chunk-000/file-000.parquet"
    path.parent.mkdir(parents=True)
    pq.write_table(pa.table({"length": range(300)}), path, row_group_size=100)
    with path.open("r+b") as file:  # the last hundred cannot be read
        file.seek(pq.read_metadata(path).row_group(2).column(0).data_page_offset)
        file.write(bytes(8))
    assert next(plain.episode_rows(tmp_path, statistics=True)) == {"length": 0}


COLUMNS = [plain.PlainColumn(EPISODE_INDEX, "int64", 1), plain.PlainColumn(FRAME_INDEX, "int64", 1)]


def split(episodes: list[int], frames: list[int], block: int) -> list[tuple[list[int], list[int]]]:
    table = pa.table({EPISODE_INDEX: episodes, FRAME_INDEX: frames})

    def blocks() -> Iterator[pa.Table]:
        for first in range(0, len(table), block):
            yield table.slice(first, block)

    found = list(plain.runs(Path("data/file.parquet"), blocks(), COLUMNS))
    assert [run.row + len(run) for run in found] == np.cumsum([len(run) for run in found]).tolist()
    return [(run.columns[EPISODE_INDEX].tolist(), run.columns[FRAME_INDEX].tolist()) for run in found]


@pytest.mark.parametrize("block", [1, 2, 3, 100])
def test_rows_are_split_where_episodes_begin(block: int) -> None:
    assert split([0, 0, 0, 1, 2, 2], [0, 1, 2, 0, 0, 1], block) == [
        ([0, 0, 0], [0, 1, 2]),
        ([1], [0]),
        ([2, 2], [0, 1]),
    ]
    assert split([2, 2, 1], [0, 1, 0], block) == [([2, 2], [0, 1]), ([1], [0])]  # episodes may come in any order
    # One wrong value of either stays inside of its episode.
    assert split([0, 9, 0, 1], [0, 1, 2, 0], block) == [([0, 9, 0], [0, 1, 2]), ([1], [0])]
    assert split([0, 0, 0, 1], [0, 0, 2, 0], block) == [([0, 0, 0], [0, 0, 2]), ([1], [0])]
    assert split([], [], block) == []


def a_run(**changes: Array) -> plain.Run:
    """Return episode 3 of 4 steps at 10 steps per second, whose first row is 20."""
    frame = np.arange(4)
    columns: dict[str, Array] = {
        INDEX: frame + 20,
        EPISODE_INDEX: np.full(4, 3),
        FRAME_INDEX: frame,
        TIMESTAMP: (frame / 10).astype(np.float32),
        "state": np.zeros((4, 2), np.float32),
    }
    return plain.Run(Path("file.parquet"), 0, columns | changes)


@pytest.mark.parametrize(
    ("name", "at", "value", "sentence"),
    [
        (INDEX, 1, 9, "index is 9 in episode 3 frame 1, expected 21"),
        (EPISODE_INDEX, 2, 2, "episode_index is 2 in episode 3 frame 2, expected 3"),
        (FRAME_INDEX, 3, 0, "frame_index is 0 in episode 3 frame 3, expected 3"),
        (TIMESTAMP, 1, 0.1002, "in episode 3 frame 1, expected 0.1"),
        (TIMESTAMP, 1, np.nan, "timestamp is nan in episode 3 frame 1, expected 0.1"),
        ("state", (2, 1), np.inf, "state is inf in episode 3 frame 2 index 1, expected a finite number"),
    ],
)
def test_wrong_values_of_a_run_are_found(name: str, at: int | tuple[int, int], value: float, sentence: str) -> None:
    assert list(plain.run_faults(a_run(), number=3, row=20, fps=10)) == []
    values = a_run().columns[name].copy()
    values[at] = value
    [(column, fault)] = plain.run_faults(a_run(**{name: values}), number=3, row=20, fps=10)
    assert column == name and sentence in fault and "a second" not in fault


@pytest.mark.parametrize(("offset", "step", "told"), [(0.0, 0.05, "they are 20 a second"), (5.0, 0.1, "")])
def test_timestamps_of_another_rate_name_it(offset: float, step: float, told: str) -> None:
    values = (offset + step * np.arange(4)).astype(np.float32)
    [(_, fault)] = plain.run_faults(a_run(**{TIMESTAMP: values}), number=3, row=20, fps=10)
    assert fault.partition("wrong)")[2] == (told and f": {told}, the fps of meta/info.json is 10")


@pytest.mark.parametrize(
    ("terminated", "truncated", "done", "faults"),
    [
        ("0001", "0000", "0001", []),
        ("0000", "0001", "0001", []),
        ("0001", "0001", "0001", []),
        ("0100", "0000", "0100", [("terminated", "frame 1"), ("done", "frame 1")]),
        ("0000", "0000", "0001", [("done", "expected False")]),
        ("0001", "0000", "0000", [("done", "expected True")]),
    ],
)
def test_flags_end_the_last_step_only_and_agree(
    terminated: str, truncated: str, done: str, faults: list[tuple[str, str]]
) -> None:
    flags = {"next.terminated": terminated, "next.truncated": truncated, "next.done": done}
    run = a_run(**{name: np.array([bit == "1" for bit in bits]) for name, bits in flags.items()})
    found = list(plain.flag_faults(run.columns, "episode 3 "))
    assert len(found) == len(faults)
    for sentence, (name, part) in zip(found, faults, strict=True):
        assert sentence.startswith(f"next.{name} is ") and part in sentence
