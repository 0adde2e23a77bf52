"""A policy as LeRobot makes it from its folder, beside the policy of the package."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.pipeline.trained_policy import load_policy


@pytest.fixture(scope="module")
def made(run: Path) -> Any:
    """LeRobot's own way from a folder to a policy."""
    from lerobot.configs import PreTrainedConfig  # noqa: PLC0415 - takes seconds
    from lerobot.policies import get_policy_class  # noqa: PLC0415

    import astra_data.deployment.lerobot.configuration_astra_data  # noqa: F401, PLC0415 - registers

    folder = run.with_name("policy")
    config = PreTrainedConfig.from_pretrained(folder)
    return get_policy_class(config.type).from_pretrained(folder, config=config)


def shown(state: Tensor, goal: Tensor) -> dict[str, Tensor]:
    return {"observation.state": state, "observation.environment_state": goal}


def test_commands_of_many_robots_are_those_of_the_package(made: Any, run: Path) -> None:
    here = load_policy(run, "direct_transfer")
    draw = torch.Generator().manual_seed(0)
    goal = torch.rand(3, 1, generator=draw)
    for _ in range(2):  # episodes
        made.reset()
        here.start(3)
        for _ in range(5):
            state = torch.rand(3, 2, generator=draw)
            expected = here.task.limits.in_units(here.act(state, goal))
            found = made.select_action(shown(state, goal))
            torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)
    state = torch.rand(3, 2, generator=draw)
    expected = here.task.limits.in_units(here.act(state, goal))
    chunk = made.predict_action_chunk(shown(state, goal))
    torch.testing.assert_close(chunk, expected[:, None], atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("batch", "message"),
    [
        (shown(torch.zeros(1, 3), torch.zeros(1, 1)), r"observation\.state: expected .*\(B, 2\).*\(1, 3\)"),
        (shown(torch.full((1, 2), torch.nan), torch.zeros(1, 1)), r"observation\.state: .* that are not finite"),
        (shown(torch.zeros(1, 2), torch.full((1, 1), torch.inf)), r"environment_state: expected finite"),
        ({"observation.state": torch.zeros(1, 2)}, r"observation\.environment_state: expected .*got none"),
    ],
)
def test_other_observations_are_refused(made: Any, batch: dict[str, Tensor], message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        made.select_action(batch)


def test_another_number_of_robots_needs_a_reset(made: Any) -> None:
    made.reset()
    made.select_action(shown(torch.zeros(3, 2), torch.zeros(3, 1)))
    for robots, goals in ((2, 2), (4, 4), (3, 2)):
        with pytest.raises(BadInputError, match=f"of 3 robots.* got {robots} states and {goals} goals"):
            made.select_action(shown(torch.zeros(robots, 2), torch.zeros(goals, 1)))
    made.reset()
    assert made.select_action(shown(torch.zeros(2, 2), torch.zeros(2, 1))).shape[0] == 2


def test_a_folder_without_a_policy_is_refused(made: Any, run: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"--policy\.path: expected a folder .* got none"):
        type(made)(type(made.config)())
    for name in ("config.json", "policy.onnx"):
        shutil.copy(run.with_name("policy") / name, tmp_path)
    with pytest.raises(BadInputError, match=f"astra-data deploy wrote, got {tmp_path}"):
        type(made).from_pretrained(tmp_path)
    for name, told in (("policy.onnx", r"policy\.onnx was altered"), ("manifest.json", "deploy wrote them, got")):
        robot = shutil.copytree(run.with_name("policy"), tmp_path / "robot", dirs_exist_ok=True)
        (robot / name).write_bytes(b"other")
        with pytest.raises(BadInputError, match=f"{told}.*: copy the folder again"):
            type(made).from_pretrained(robot)
    for refuses in (lambda: made.forward({}), made.get_optim_params, made.config.get_optimizer_preset):
        with pytest.raises(NotImplementedError, match="astra-data train does"):
            refuses()


def test_values_of_double_precision_are_taken(made: Any) -> None:
    commands = []
    for kind in (torch.float32, torch.float64):
        made.reset()
        commands.append(made.select_action(shown(torch.ones(1, 2, dtype=kind), torch.ones(1, 1, dtype=kind))))
    assert torch.equal(*commands)
