import json
from pathlib import Path

import numpy as np
import pytest
from fake_runs import edit_json, outcomes, write_evaluation
from safetensors.numpy import save_file

from astra_data.core.artifact import write_manifest
from astra_data.core.errors import BadInputError
from astra_data.reports.artifacts import Evaluation, read_json, read_tensors, way_to_success


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


def test_a_file_that_was_altered_is_not_read(path: Path) -> None:
    write_manifest(path.parent, {})
    assert read_json(Evaluation, path)
    altered = bytearray(path.read_bytes())
    altered[-5] ^= 1
    path.write_bytes(altered)
    with pytest.raises(BadInputError, match=r"evaluation\.json was altered since it was made: restore it"):
        read_json(Evaluation, path)


def test_a_malformed_artifact_is_named_with_every_fault(path: Path) -> None:
    edit_json(path, wall_seconds="long", seed=None)
    with pytest.raises(BadInputError, match=r"evaluation.json is not .*wall_seconds: .*seed: "):
        read_json(Evaluation, path)
    path.write_text("{")
    with pytest.raises(BadInputError, match=r"file: .*; run that stage again"):
        read_json(Evaluation, path)


def test_tensors_are_checked_and_become_float64(tmp_path: Path) -> None:
    path = tmp_path / "some.safetensors"
    save_file({"goal": np.ones((2, 2), np.float32)}, path)
    assert read_tensors(path, ("goal",))["goal"].dtype == np.float64
    with pytest.raises(BadInputError, match=r"expected tensors \['start'\], got \['goal'\]"):
        read_tensors(path, ("goal", "start"))


def test_the_way_is_that_of_the_robot_in_episodes_that_succeed(path: Path) -> None:
    robot = np.full((4, 4, 2), np.nan)
    robot[0, :3] = [[0, 0], [3, 4], [0, 0]]  # 10 m, then over
    robot[1] = [[0, 0], [0, 1], [0, 2], [0, 3]]
    robot[2] = 100 * robot[1]
    tensors = path.with_name("some.safetensors")
    save_file({"target.position": np.concatenate([robot, -7 * robot], axis=-1)}, tensors)  # whatever its ball does
    values = json.loads(path.read_text())
    file = Evaluation.model_validate(values | {"target": outcomes([1, 1, 0, 0], 0)})
    assert way_to_success(tensors, file) == pytest.approx((10 + 3) / 2)
    failed = Evaluation.model_validate(values | {"target": outcomes([0, 0, 0, 0], 0)})
    assert np.isnan(way_to_success(tensors, failed))
