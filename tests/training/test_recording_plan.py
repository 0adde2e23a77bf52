import json
from pathlib import Path
from typing import Any

import pytest
import torch
from small_cart import TASK

from astra_data.core.errors import BadInputError
from astra_data.training.recording_plan import PlannedCommands, RecordingPlan

GOOD: dict[str, Any] = {
    "task": "rail-cart",
    "timestep_s": 0.1,
    "start_names": ["x"],
    "command_names": ["v"],
    "episodes": [
        {"start": [0.5], "commands": [[-1.0], [4.0]], "hold_steps": [1, 2], "information": 3.0},
        {"start": [0.0], "commands": [[1.5]], "hold_steps": [1]},
    ],
}


def written(folder: Path, **changed: object) -> Path:
    path = folder / "plan.json"
    path.write_text(json.dumps(GOOD | changed))
    return path


def test_commands_are_held_in_turn_and_the_last_one_on(tmp_path: Path) -> None:
    plan = RecordingPlan.load(written(tmp_path), TASK)
    assert plan.starts.tolist() == [[0.5], [0.0]] and plan.longest == 3
    # -1 to 4 m/s are -1 to 1; 1.5 m/s are in the middle.
    assert plan.actions(TASK)[..., 0].T.tolist() == [[-1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]


def test_they_are_played_step_by_step_and_again_from_the_start() -> None:
    played = PlannedCommands(torch.arange(6.0).view(3, 2, 1))
    nothing = torch.empty(1, 0)
    for _ in range(2):
        played.start(range(1, 2), seed=0)
        assert [played.act(nothing, nothing).item() for _ in range(3)] == [1.0, 3.0, 5.0]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"timestep_s": 0.2}, r"plan for rail-cart.*0\.1 s of rail-cart"),
        ({"command_names": ["w"]}, r"\('w',\).*expected \('x',\), \('v',\)"),
        ({"start_names": ["y"]}, r"\('y',\).*expected \('x',\), \('v',\)"),
        ({"episodes": []}, r"expected a plan as `astra-data suggest` writes it: episodes: .*at least 1"),
        (
            {"episodes": [{"start": [0.0, 1.0], "commands": [[0.0]], "hold_steps": [1]}]},
            "episode 0: .* of 1 val",
        ),
        (
            {"episodes": [{"start": [0.0], "commands": [[0.0, 1.0]], "hold_steps": [1]}]},
            "episode 0: .* of 1 val",
        ),
        (
            {"episodes": [{"start": [0.0], "commands": [[0.0]], "hold_steps": [1, 2]}]},
            "how long each is held",
        ),
    ],
)
def test_a_plan_of_another_robot_is_refused(tmp_path: Path, changed: dict[str, object], message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        RecordingPlan.load(written(tmp_path, **changed), TASK)


def test_a_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"nowhere\.json cannot be read as a plan: No such file"):
        RecordingPlan.load(tmp_path / "nowhere.json", TASK)
