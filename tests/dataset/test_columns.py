from typing import Any

import numpy as np
import pytest
import torch
from fake_dataset import COLUMNS, fake_columns

from astra_data.core.errors import BadInputError
from astra_data.dataset import columns as keys


def test_a_column_survives_the_way_through_features() -> None:
    assert [keys.Column.from_feature(column.name, column.feature()) for column in COLUMNS] == list(COLUMNS)


def test_a_feature_carries_what_each_index_means() -> None:
    assert COLUMNS[0].feature() == {
        "dtype": "float32",
        "shape": [3],
        "names": ["x", "y", "yaw"],
        "astra": {"meaning": "pose", "unit": ["m", "m", "rad"], "role": ["position", "position", "heading"]},
    }


def test_a_column_that_contradicts_itself_is_refused_with_every_fault() -> None:
    with pytest.raises(BadInputError) as caught:
        keys.Column("a/b", "float16", 2, names=("x",), astra={"unit": ["m"], "role": ["pos", "heading"], "x": []})
    message = str(caught.value)
    for part in ("'/'", "float16", "1 names for 2", "1 words in astra's unit", "unknown role pos", "has 'x'"):
        assert part in message
    for given in ({"names": (1,)}, {"meaning": 1}, {"astra": {"unit": [1]}}, {"names": ("\ud800",)}):
        with pytest.raises(BadInputError, match="expected texts of valid characters in names, meaning and astra"):
            keys.Column("a", **given)
    for name in ("", ".", "..", "a\0", 201 * "a"):
        with pytest.raises(BadInputError, match="the name must have 1 to 200 bytes, without '/', and name a file"):
            keys.Column(name)


def test_an_episode_makes_its_columns_contiguous_and_its_metadata_plain() -> None:
    batch = np.zeros((5, 8, 3), np.float32)
    metadata: dict[str, Any] = {"success": np.bool_(True), "return": np.float32(0.5)}
    episode = keys.Episode(0, {keys.STATE: batch[:, 2]}, metadata)
    assert episode.columns[keys.STATE].flags.c_contiguous and episode.metadata == {"success": True, "return": 0.5}
    assert {type(value) for value in episode.metadata.values()} == {bool, float}


def test_every_fault_of_an_episode_is_reported_at_once() -> None:
    columns: dict[str, Any] = dict(fake_columns(6, seed=1))
    columns[keys.STATE][4, 1] = np.nan
    columns[keys.STATE][5, 0] = np.inf
    columns[keys.ACTION] = columns[keys.ACTION].astype(np.float64)
    columns[keys.REWARD] = columns[keys.REWARD][:5, None, None]
    columns["episode_uid"] = np.zeros(6, np.int64)
    columns["force"], columns["torque"] = torch.ones(6, requires_grad=True), torch.ones(6, dtype=torch.bfloat16)
    columns["uneven"] = [[1.0], [1.0, 2.0]]
    with pytest.raises(BadInputError) as caught:
        keys.Episode(-1, columns, {"return": float("nan"), "seeds": [1]})  # type: ignore[dict-item]
    message = str(caught.value)
    assert "\n" not in message
    for part in (
        "uid -1",
        "observation.state: 2 values are not finite, the first in frame 4 index 1",
        "action: dtype float64",
        "next.reward: shape (5, 1, 1), expected (T,) or (T, size)",
        "next.reward 5",
        "episode_uid: is filled in by the writer",
        "force: Can't call numpy() on Tensor that requires grad; expected an array, or tensor.detach().cpu().float()",
        "torque: Got unsupported ScalarType BFloat16; expected an array, or tensor.detach()",
        "uneven: setting an array element with a sequence; expected an array",
        "metadata return: nan",
        "metadata seeds: list",
    ):
        assert part in message


def test_one_value_per_step_may_be_given_as_gymnasium_has_it() -> None:
    rewards = np.arange(3, dtype=np.float32)
    assert keys.Episode(0, {keys.REWARD: rewards[:, None]}).columns[keys.REWARD].tolist() == [0.0, 1.0, 2.0]
    assert keys.Episode(0, {keys.STATE: np.zeros((1, 2), np.float32)}).columns[keys.STATE].shape == (1, 2)
    for empty in (np.zeros((3, 0), np.float32), np.zeros((3, 1, 0), np.float32)):
        with pytest.raises(BadInputError, match=r"next.reward: shape .*, expected \(T,\) or \(T, size\)"):
            keys.Episode(0, {keys.REWARD: empty})


def test_an_empty_episode_is_refused() -> None:
    state: dict[str, Any] = {"no steps": np.zeros((0, 2), np.float32), r"shape \(\)": np.float32(1)}
    for part, columns in {"no columns": {}, **{part: {keys.STATE: one} for part, one in state.items()}}.items():
        with pytest.raises(BadInputError, match=part):
            keys.Episode(0, columns)


def test_roles_must_make_sense() -> None:
    for astra, fault in (
        ({"role": ["position", "vector", "vector"]}, "role position at index 0, expected 2 indices"),
        ({"role": ["heading", "heading", "position"]}, "role position at index 2, expected 2 indices"),
        ({"mirror": ["a", "b", "c"]}, "astra has 'mirror', expected unit, frame, role"),
    ):
        with pytest.raises(BadInputError, match=fault):
            keys.Column("pose", size=3, names=("a", "b", "c"), astra=astra)


def test_a_damaged_entry_of_features_is_bad_input() -> None:
    damage: list[dict[str, Any]] = [{"astra": {"unit": 5}}, {"astra": "m"}, {"names": 3}, {"shape": []}, {"shape": "x"}]
    for change in damage:
        with pytest.raises(BadInputError, match="Column 'x'"):
            keys.Column.from_feature("x", {"dtype": "float32", "shape": [1], "names": None} | change)


def test_a_block_ends_with_the_episode_that_fills_it() -> None:
    """None is left out or split, and the last is there though it isn't full."""
    columns = [{"action": np.zeros(length, np.float32)} for length in (3, 2, 9, 1, 4, 1)]
    blocks = keys.in_blocks((keys.Episode(uid, one) for uid, one in enumerate(columns)), rows=5)
    assert [[episode.uid for episode in block] for block in blocks] == [[0, 1], [2], [3, 4], [5]]


def test_a_uid_that_is_taken_is_replaced_by_one_that_is_free_and_fits_a_column() -> None:
    """It is 64 bits with a sign, and depends on where the episode comes from."""
    new = keys.new_uid(7, b"origin", {7})
    assert new != 7 and 0 <= new < 2**63 and new == keys.new_uid(7, b"origin", {7})
    assert new != keys.new_uid(7, b"another", {7}) and keys.new_uid(7, b"origin", {7, new}) not in {7, new}
