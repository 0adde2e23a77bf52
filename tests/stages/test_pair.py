import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from astra_data.columns import (
    ABSTRACT_NEXT_STATE,
    ABSTRACT_SIMULATED_NEXT_STATE,
    ABSTRACT_STATE,
    ACTION,
    NEXT_STATE,
    STATE,
)
from astra_data.dataset import Dataset
from astra_data.errors import BadInputError, CorruptDatasetError
from astra_data.progress import silent
from astra_data.stages.pair import PairConfig, pair, pair_steps
from astra_data.tasks import TASKS

_PLANAR = [0, 1, 15, 16]
"""x, y, vx and vy in an ant's qpos (15) and qvel (14)."""


def test_the_simulator_starts_where_the_target_was_and_takes_its_action(paired: Path) -> None:
    names = (STATE, ACTION, NEXT_STATE, ABSTRACT_STATE, ABSTRACT_NEXT_STATE, ABSTRACT_SIMULATED_NEXT_STATE)
    columns = Dataset.open(paired).columns(names)
    np.testing.assert_array_equal(columns[ABSTRACT_STATE], columns[STATE][:, _PLANAR])
    np.testing.assert_array_equal(columns[ABSTRACT_NEXT_STATE], columns[NEXT_STATE][:, _PLANAR])
    position = columns[STATE][:, :2].astype(np.float64)
    landed = columns[ABSTRACT_SIMULATED_NEXT_STATE]
    free = TASKS["antmaze-umaze"].maze.clearance(position) > 0.4
    assert free.sum() > 100
    np.testing.assert_allclose(landed[free, :2], (position + 0.05 * columns[ACTION])[free], atol=1e-5)
    np.testing.assert_allclose(landed[free, 2:], columns[ACTION][free], atol=1e-4)


def test_all_else_stays_and_the_parent_is_recorded(collected: Path, paired: Path) -> None:
    before, after = Dataset.open(collected), Dataset.open(paired)
    assert after.description["parents"] == [before.identity]
    assert after.description["simulator"] == {"id": "point_mass", "timestep_s": 0.05, "radius_m": 0.1}
    steps = after.description["pairs_per_second"] * after.description["wall_seconds"]
    assert steps == pytest.approx(after.lengths.sum())
    assert after.description["machine"] == before.description["machine"]
    assert after.order == before.order
    assert after.metadata == before.metadata
    for one, other in zip(before.episodes(), after.episodes(), strict=True):
        assert one.uid == other.uid
        for name, values in one.columns.items():
            np.testing.assert_array_equal(values, other.columns[name])


def test_abstract_columns_have_units_frames_and_roles(paired: Path) -> None:
    features = Dataset.open(paired).features
    meanings = set()
    for name in (ABSTRACT_STATE, ABSTRACT_NEXT_STATE, ABSTRACT_SIMULATED_NEXT_STATE):
        astra = features[name]["astra"]
        meanings.add(astra["meaning"])
        assert features[name]["names"] == ["x", "y", "vx", "vy"]
        for key in ("unit", "frame", "role"):  # as in the target's columns
            assert astra[key] == [features[STATE]["astra"][key][index] for index in _PLANAR]
    assert len(meanings) == 3


def test_a_simulator_that_does_not_show_its_reset_is_refused() -> None:
    task = TASKS["antmaze-umaze"]
    shifted = replace(task, abstraction=_unclean)
    with pytest.raises(BadInputError, match=r"step 0, shows x = .* and not") as caught:
        pair_steps(shifted, np.zeros((2, 29), "f4"), np.zeros((2, 2), "f4"), np.zeros((2, 29), "f4"), -1.0)
    assert "\n" not in str(caught.value)


def _unclean(state: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> torch.Tensor:
    return state[..., _PLANAR]  # type: ignore[return-value]


def test_a_damaged_dataset_is_refused(task: str, collected: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged"
    shutil.copytree(collected, damaged)
    data = next(damaged.glob("data/*/*.parquet"))
    data.write_bytes(data.read_bytes()[:-200])
    with pytest.raises(CorruptDatasetError, match="incomplete or was altered") as caught:
        pair(task, PairConfig(), dataset=damaged, out=tmp_path / "out", progress=silent)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()
