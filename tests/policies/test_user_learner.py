"""A learner of the user's in the simulator of a row."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from constant_policy import Constant
from small_cart import TASK, Last
from toy_episodes import toy_episodes

from astra_data.core.errors import BadInputError
from astra_data.deployment.graph import write_graph
from astra_data.grounding.simulator import NO_GROUNDING
from astra_data.policies.gymnasium import WatchedEnv
from astra_data.policies.running_policy import KINDS, Array, PolicyFile, add_policy_kind, running
from astra_data.policies.train import PpoTrainConfig, Training, UserLearner
from astra_data.worlds.task import Task


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(KINDS, "constant", Constant)


def training(folder: Path, progress: Callable[[float, str], None] = lambda share, note: None) -> Training:
    one = torch.zeros(1, 3, 1)
    return Training(
        task=TASK,
        config=PpoTrainConfig(num_envs=4, total_steps=400, data_start_share=0.0),
        settings=None,
        episodes=toy_episodes(one, one, next_state=one),
        grounding=NO_GROUNDING,
        initial=None,
        seed=7,
        device="cpu",
        folder=folder,
        progress=progress,
    )


def driving(command: float, steps: int, seen: list[Array] | None = None) -> UserLearner:
    def learn(env: WatchedEnv, training: Training) -> Constant:
        env.reset()
        for _ in range(steps // env.num_envs):
            observation, *_ = env.step(np.full((env.num_envs, 1), command))
            if seen is not None:
                seen.append(observation)
        return Constant(command)

    return UserLearner(learn=learn, policy=Constant)


@pytest.mark.parametrize(("command", "success"), [(1.0, 1.0), (-1.0, 0.0)])
def test_its_curve_is_kept_for_it(tmp_path: Path, command: float, success: float) -> None:
    """Forward at 4 m/s every goal, at most 2 m away, is reached in 5 steps; backward none is in 40."""
    told: list[tuple[float, str]] = []
    given = training(tmp_path, lambda share, note: told.append((share, note)))
    _, curve = driving(command, steps=400)(given)
    points = curve["points"]
    assert [point["steps"] for point in points[:3]] == [8, 16, 24]
    assert points[-1]["steps"] == 400 and len(points) == 50
    assert [point["share"] for point in points] == pytest.approx([step / 50 for step in range(1, 51)])
    ended = [point["success"] for point in points if point["success"] is not None]
    assert set(ended) == {success} and told[-1][0] == 1.0
    # Backward all four end at steps 160 and 320, by the horizon of 40.
    lengths = {point["steps"]: point["episode_steps"] for point in points if point["success"] is not None}
    assert lengths == {160: 40.0, 320: 40.0} or (success and all(1 <= last <= 5 for last in lengths.values()))
    assert told[-1][1].startswith("success of training episodes ")


@pytest.mark.parametrize(
    ("is_plus", "task", "command", "expected"),
    [
        (True, TASK, 1.0, [0.0] * 10 + [0.4]),
        (True, TASK, -1.0, [0.0] * 11),
        (False, TASK, 1.0, [1.0] * 11),
        (True, replace(TASK, objective=Last(horizon=40)), 1.0, [1.0] * 11),
    ],
)
def test_prices_grow_as_in_other_trainings(
    tmp_path: Path, is_plus: bool, task: Task, command: float, expected: list[float]
) -> None:
    given, scales = replace(training(tmp_path), is_plus=is_plus, task=task), list[float]()

    def learn(env: WatchedEnv, training: Training) -> Constant:
        env.reset()
        for _ in range(11):
            # After a tenth of the training, over a quarter of which prices grow.
            env.points[:] = [] if len(scales) < 10 else [{"share": 0.1, "success": max(0.0, command)}]
            env.step(np.full((4, 1), command))
            scales.append(env.env.env.penalty_scale)  # type: ignore[union-attr]
        return Constant(command)

    UserLearner(learn=learn, policy=Constant)(given)
    assert scales == pytest.approx(expected)


def test_it_runs_on_the_cpu_alone(tmp_path: Path) -> None:
    given = training(tmp_path)
    object.__setattr__(given, "device", "cuda")
    with pytest.raises(BadInputError, match=r"--device cuda: a learner of your own .* expected --device cpu"):
        driving(1.0, 8)(given)


def test_its_policy_comes_back_from_the_file(tmp_path: Path) -> None:
    policy, _ = driving(0.25, 8)(training(tmp_path))
    policy.save(tmp_path / "policy.safetensors")
    read = running(TASK, PolicyFile.load(tmp_path / "policy.safetensors"))
    read.start(2)
    assert read.act(torch.zeros(2, 2), torch.ones(2, 1)).tolist() == [[0.25], [0.25]]
    with pytest.raises(BadInputError, match="Constant is a policy of another learner, which cannot be traced"):
        write_graph(read, tmp_path)
    del KINDS["constant"]
    with pytest.raises(BadInputError, match="found kind constant"):
        PolicyFile.load(tmp_path / "policy.safetensors")


def test_a_kind_of_the_package_is_not_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Constant, "kind", "actor_critic")
    with pytest.raises(BadInputError, match="policies of kind 'actor_critic' are the package's"):
        add_policy_kind(Constant)


def test_another_learners_kind_is_not_replaced() -> None:
    other = type("Other", (Constant,), {})
    with pytest.raises(BadInputError, match=r"policies of kind 'constant' are .*: rename that of Other"):
        add_policy_kind(other)
    add_policy_kind(Constant)
    assert KINDS["constant"] is Constant
