import json
from pathlib import Path

import numpy as np
import pytest
from fake_runs import band, edit_json, outcomes, write_evaluation, write_json
from safetensors.numpy import save_file

from astra_data.core.artifact import write_manifest
from astra_data.core.errors import BadInputError
from astra_data.reports.artifacts import (
    Evaluation,
    Gap,
    read_json,
    read_tensors,
    way_to_success,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_evaluation(tmp_path, "astra", 1)
    return tmp_path / "evaluate/astra/seed_1/evaluation.json"


def test_means_are_over_episodes_under_the_names_in_the_file(path: Path) -> None:
    """Also of measures that only the stage knows."""
    edit_json(path, color="red", target=outcomes([1, 0, 0, 0], 1) | {"falls": [0.0, 1.0, 2.0, 3.0]})
    means = read_json(Evaluation, path).outcomes.means()
    assert means == pytest.approx(
        {"success": 0.25, "failed": 0.75, "wall_contact": 0.2, "steps": 115.0, "return": 1.0, "falls": 1.5}
    )


@pytest.mark.parametrize("name", ["evaluation.json", "trajectories.safetensors"])
def test_a_file_that_was_altered_is_not_read(name: str, path: Path) -> None:
    write_manifest(path.parent, {})
    assert read_json(Evaluation, path) and read_tensors(path.with_name("trajectories.safetensors"), ())
    file = path.with_name(name)
    altered = bytearray(file.read_bytes())
    altered[-5] ^= 1
    file.write_bytes(altered)
    with pytest.raises(BadInputError, match=f"{name} was altered since it was made: restore it from a copy"):
        read_json(Evaluation, file) if name == path.name else read_tensors(file, ())


def test_a_malformed_artifact_is_named_with_every_fault(path: Path) -> None:
    edit_json(path, episodes=5, wall_seconds="long", seed=None)
    with pytest.raises(BadInputError, match=r"evaluation.json is not .*wall_seconds: .*seed: "):
        read_json(Evaluation, path)
    edit_json(path, wall_seconds=1.0, seed=1)
    with pytest.raises(BadInputError, match=r"expected 5 episodes, but target.success has 4"):
        read_json(Evaluation, path)
    edit_json(path, episodes=4, raw=outcomes([1, 0], 1))
    with pytest.raises(BadInputError, match=r"raw.success has 2.*raw.return has 2"):
        read_json(Evaluation, path)
    path.write_text("{")
    with pytest.raises(BadInputError, match=r"file: .*; run that stage again"):
        read_json(Evaluation, path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"raw": {"turn_rad": band(1.0)}}, "grounded has .*position_m.*, but raw has .*turn_rad"),
        ({"horizons": [1, 10, 100]}, r"expected 3 numbers for position_m, got \[2\]"),
        ({"grounded": {"position_m": band(1.0) | {"low": [0.5]}}}, r"for position_m, got \[1, 2\]"),
    ],
)
def test_a_gap_has_one_error_per_horizon_and_quantity(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    path = tmp_path / "gap.json"
    good = {"horizons": [1, 10], "grounded": {"position_m": band(0.1)}, "raw": {"position_m": band(1.0)}}
    write_json(path, good)
    assert read_json(Gap, path).grounded["position_m"].mean == [0.1, 0.2]
    write_json(path, good | changes)
    with pytest.raises(BadInputError, match=message):
        read_json(Gap, path)


def test_tensors_are_checked_and_become_float64(tmp_path: Path) -> None:
    path = tmp_path / "some.safetensors"
    save_file({"goal": np.ones((2, 2), np.float32)}, path)
    assert read_tensors(path, ("goal",))["goal"].dtype == np.float64
    with pytest.raises(BadInputError, match=r"expected tensors \['start'\], got \['goal'\]"):
        read_tensors(path, ("goal", "start"))
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(BadInputError, match="not a complete safetensors file"):
        read_tensors(path, ("goal",))


def test_the_way_is_that_of_the_robot_in_episodes_that_succeed(path: Path) -> None:
    robot = np.full((4, 4, 2), np.nan)
    robot[0, :3] = [[0, 0], [3, 4], [0, 0]]  # 10 m, then over
    robot[1] = [[0, 0], [0, 1], [0, 2], [0, 3]]
    robot[2] = 100 * robot[1]
    tensors = path.with_name("some.safetensors")
    # Whatever its ball does.
    save_file({"target.position": np.concatenate([robot, -7 * robot], axis=-1)}, tensors)
    values = json.loads(path.read_text())
    file = Evaluation.model_validate(values | {"target": outcomes([1, 1, 0, 0], 0)})
    assert way_to_success(tensors, file) == pytest.approx((10 + 3) / 2)
    failed = Evaluation.model_validate(values | {"target": outcomes([0, 0, 0, 0], 0)})
    assert np.isnan(way_to_success(tensors, failed))
