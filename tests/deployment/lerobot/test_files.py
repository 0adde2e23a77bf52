"""What lies beside a policy, as LeRobot writes it itself."""

import json
from pathlib import Path

import pytest

from astra_data.deployment.folder import write_lerobot_files

NAMES = {"state": ["x", "v"], "goal": ["dock"], "command": ["push"]}


def written(folder: Path, **changed: list[str]) -> dict[str, object]:
    about = {column: {"names": names} for column, names in (NAMES | changed).items()}
    write_lerobot_files(about, folder)
    return {path.name: json.loads(path.read_text()) for path in folder.iterdir()}


def test_pipelines_are_those_that_lerobot_writes(tmp_path: Path) -> None:
    from lerobot.processor import (  # noqa: PLC0415 - takes seconds
        AddBatchDimensionProcessorStep,
        DeviceProcessorStep,
        PolicyProcessorPipeline,
        RenameObservationsProcessorStep,
    )

    steps = {
        "policy_preprocessor": [
            RenameObservationsProcessorStep(rename_map={}),
            AddBatchDimensionProcessorStep(),
            DeviceProcessorStep(device="cpu"),
        ],
        "policy_postprocessor": [DeviceProcessorStep(device="cpu")],
    }
    theirs, ours = tmp_path / "theirs", tmp_path / "ours"
    for folder in (theirs, ours):
        folder.mkdir()
    found = written(ours)
    for name, of_pipeline in steps.items():
        PolicyProcessorPipeline(steps=of_pipeline, name=name).save_pretrained(theirs)
        assert found[f"{name}.json"] == json.loads((theirs / f"{name}.json").read_text())


@pytest.mark.parametrize("goal", [["dock"], []])
def test_settings_are_read_by_lerobot(tmp_path: Path, goal: list[str]) -> None:
    from lerobot.configs import FeatureType, PreTrainedConfig  # noqa: PLC0415 - takes seconds

    import astra_data.deployment.lerobot.configuration_astra_data  # noqa: F401, PLC0415 - registers

    written(tmp_path, goal=goal)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    assert (config.type, config.device) == ("astra_data", "cpu")
    assert config.robot_state_feature.shape == (2,) and config.action_feature.shape == (1,)
    assert [feature.type for feature in config.input_features.values()] == (
        [FeatureType.STATE, FeatureType.ENV] if goal else [FeatureType.STATE]
    )
