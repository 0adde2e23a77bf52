from pathlib import Path
from typing import Any

import pytest

from astra_data.core.errors import CorruptDatasetError
from astra_data.dataset.columns import STATE, Column
from astra_data.dataset.format import DEFAULT_COLUMNS
from astra_data.dataset.lerobot_rows import declared_columns, name_of

WHOLE = "expected a whole number of frames per second"
LACKING = (
    "lacks the columns episode_index, frame_index, index, task_index, timestamp, which are LeRobot's own"
)
OWN = {column.name: column.feature() for column in DEFAULT_COLUMNS}


def declared(**features: Any) -> list[Column]:  # noqa: ANN401 - JSON
    return declared_columns(Path("set"), {"fps": 10.0, "features": OWN | features})[1]


@pytest.mark.parametrize(
    ("labels", "expected"),
    [
        (["x", "y"], ("x", "y")),
        ({"motors": ["x", "y"]}, ("x", "y")),
        ({"motors": ["x"]}, None),
        ({"a": ["x", "y"], "b": []}, None),
        (["x", 1], None),
        (None, None),
    ],
)
def test_names_are_taken_where_there_is_one_per_value(
    labels: object, expected: tuple[str, ...] | None
) -> None:
    feature = {"dtype": "float64", "shape": [2], "names": labels}
    assert declared(**{STATE: feature}) == [Column(STATE, "float32", 2, expected)]


def test_only_lists_of_numbers_are_columns() -> None:
    features = {
        "observation.images.top": {"dtype": "video", "shape": [8, 8, 3], "names": None},
        "text": {"dtype": "string", "shape": [1], "names": None},
        "grid": {"dtype": "float32", "shape": [2, 2], "names": None},
        "count": {"dtype": "uint8", "shape": [1], "names": None},
    }
    assert declared(**features) == [Column("count", "int64")]


def test_one_frame_per_second_is_a_rate() -> None:
    assert declared_columns(Path("set"), {"fps": 1, "features": OWN})[2] == 1


@pytest.mark.parametrize(
    ("info", "faults"),
    [
        ({"fps": 10, "features": {}}, [LACKING]),
        ({"fps": 9.5, "features": OWN}, [f"has fps 9.5, {WHOLE}"]),
        ({"fps": 0.5, "features": OWN}, [f"has fps 0.5, {WHOLE}"]),
        ({"fps": 2**31, "features": OWN}, [f"has fps 2147483648, {WHOLE}"]),
        (
            {"fps": 10, "features": OWN | {"index": {"dtype": "float64", "shape": [2]}}},
            ["has no single number a step as index"],
        ),
        ({}, [LACKING, f"has fps None, {WHOLE}"]),
    ],
)
def test_without_lerobots_own_columns_or_a_whole_rate_nothing_is_known(
    info: dict[str, Any], faults: list[str]
) -> None:
    with pytest.raises(CorruptDatasetError) as refused:
        declared_columns(Path("set"), info)
    assert str(refused.value) == f"set: meta/info.json {' and '.join(faults)}"


def test_a_folder_gives_a_valid_name() -> None:
    assert [name_of(Path(name)) for name in ("walks", "my set (2)", "-._")] == [
        "walks",
        "my-set-2-",
        "repaired",
    ]
