from typing import Any

import numpy as np
import pytest
from fake_dataset import COLUMNS, fake_columns

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, REWARD, STATE, Array, Column, Episode


def test_a_column_survives_the_way_through_features() -> None:
    assert [Column.from_feature(column.name, column.feature()) for column in COLUMNS] == list(COLUMNS)


def test_a_feature_carries_what_each_index_means() -> None:
    assert COLUMNS[0].feature() == {
        "dtype": "float32",
        "shape": [3],
        "names": ["x", "y", "yaw"],
        "astra": {"meaning": "pose", "unit": ["m", "m", "rad"], "role": ["position", "position", "heading"]},
    }


def test_a_column_that_contradicts_itself_is_refused_with_every_fault() -> None:
    with pytest.raises(BadInputError) as caught:
        Column("a/b", "float16", 2, names=("x",), astra={"unit": ["m"], "role": ["pos", "heading"], "x": []})
    message = str(caught.value)
    for part in ("'/'", "float16", "1 names for 2", "1 words in astra's unit", "unknown role pos", "has 'x'"):
        assert part in message


def test_an_episode_shows_its_shapes() -> None:
    episode = Episode(
        3, {STATE: np.zeros((4, 2), np.float32), REWARD: np.zeros(4, np.float32)}, {"return": 1.0}
    )
    assert len(episode) == 4
    assert repr(episode) == (
        "Episode(uid=3, observation.state (4, 2) float32, next.reward (4,) float32, metadata={'return': 1.0})"
    )


def test_an_episode_makes_its_columns_contiguous_and_its_metadata_plain() -> None:
    batch = np.zeros((5, 8, 3), np.float32)
    metadata: dict[str, Any] = {"success": np.bool_(True), "return": np.float32(0.5)}
    episode = Episode(0, {STATE: batch[:, 2]}, metadata)
    assert episode.columns[STATE].flags.c_contiguous
    assert episode.metadata == {"success": True, "return": 0.5}
    assert {type(value) for value in episode.metadata.values()} == {bool, float}


def test_every_fault_of_an_episode_is_reported_at_once() -> None:
    columns = fake_columns(6, seed=1)
    columns[STATE][4, 1] = np.nan
    columns[STATE][5, 0] = np.inf
    columns[ACTION] = columns[ACTION].astype(np.float64)
    columns[REWARD] = columns[REWARD][:5, None, None]
    columns["episode_uid"] = np.zeros(6, np.int64)
    with pytest.raises(BadInputError) as caught:
        Episode(-1, columns, {"return": float("nan"), "seeds": [1]})  # type: ignore[dict-item]
    message = str(caught.value)
    assert "\n" not in message
    for part in (
        "uid -1",
        "observation.state: 2 values are not finite, the first in frame 4 index 1",
        "action: dtype float64",
        "next.reward: shape (5, 1, 1), expected (T,) or (T, size)",
        "next.reward 5",
        "episode_uid: is filled in by the writer",
        "metadata return: nan",
        "metadata seeds: list",
    ):
        assert part in message


def test_one_value_per_step_may_be_given_as_gymnasium_has_it() -> None:
    rewards = np.arange(3, dtype=np.float32)
    assert Episode(0, {REWARD: rewards[:, None]}).columns[REWARD].tolist() == [0.0, 1.0, 2.0]
    assert Episode(0, {STATE: np.zeros((1, 2), np.float32)}).columns[STATE].shape == (1, 2)
    for empty in (np.zeros((3, 0), np.float32), np.zeros((3, 1, 0), np.float32)):
        with pytest.raises(BadInputError, match=r"next.reward: shape .*, expected \(T,\) or \(T, size\)"):
            Episode(0, {REWARD: empty})


@pytest.mark.parametrize(
    ("columns", "part"),
    [
        ({}, "no columns"),
        ({STATE: np.zeros((0, 2), np.float32)}, "no steps"),
        ({STATE: np.float32(1)}, "shape ()"),
    ],
)
def test_an_empty_episode_is_refused(columns: dict[str, Array], part: str) -> None:
    with pytest.raises(BadInputError) as caught:
        Episode(0, columns)
    assert part in str(caught.value)


@pytest.mark.parametrize(
    ("astra", "fault"),
    [
        ({"role": ["position", "vector", "vector"]}, "role position at index 0, expected 2 indices"),
        ({"role": ["heading", "heading", "position"]}, "role position at index 2, expected 2 indices"),
        ({"mirror": ["a", "b", "c"]}, "astra has 'mirror', expected unit, frame, role"),
    ],
)
def test_roles_must_make_sense(astra: dict[str, list[str]], fault: str) -> None:
    with pytest.raises(BadInputError, match=fault):
        Column("pose", size=3, names=("a", "b", "c"), astra=astra)


@pytest.mark.parametrize(
    "change", [{"astra": {"unit": 5}}, {"names": 3}, {"shape": []}, {"astra": "m"}, {"shape": "x"}]
)
def test_a_damaged_entry_of_features_is_bad_input(change: dict[str, object]) -> None:
    with pytest.raises(BadInputError, match="Column 'x'"):
        Column.from_feature("x", {"dtype": "float32", "shape": [1], "names": None} | change)


def test_masked_values_are_refused_and_a_mask_without_any_is_not() -> None:
    values = np.ma.array(np.arange(6, dtype=np.float32).reshape(3, 2))  # type: ignore[no-untyped-call]
    assert np.array_equal(Episode(0, {"action": values}).columns["action"], values.data)
    values[1, 0] = np.ma.masked
    with pytest.raises(BadInputError, match="action: masked values, expected a value for every step"):
        Episode(0, {"action": values})


@pytest.mark.parametrize(
    ("column", "told"),
    [
        ({"name": "x" * 201}, "the name must have 1 to 200 bytes"),
        ({"name": "\u4e16" * 67}, "the name must have 1 to 200 bytes"),
        ({"name": "x", "size": 2**30}, "size 1073741824, expected 1 to 1048576"),
    ],
)
def test_a_column_too_large_for_files_or_memories_is_refused(column: dict[str, Any], told: str) -> None:
    with pytest.raises(BadInputError, match=told):
        Column(**column)
    Column("x" * 200, size=2**20)
