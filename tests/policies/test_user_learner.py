"""A learner of the user's in the simulator of a row."""

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from constant_policy import Constant
from small_cart import TASK, Last
from toy_episodes import toy_episodes

from astra_data.core.errors import BadInputError
from astra_data.core.progress import Progress, silent
from astra_data.core.seeding import derive
from astra_data.deployment.graph import write_graph
from astra_data.grounding.simulator import NO_GROUNDING
from astra_data.policies.gymnasium import WatchedEnv
from astra_data.policies.learner import KINDS, add_policy_kind
from astra_data.policies.networks import UserPolicy
from astra_data.policies.running_policy import PolicyFile, running
from astra_data.policies.train import PpoTrainConfig, Training, UserLearner, with_restarts
from astra_data.worlds.task import Task


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(KINDS, "constant", Constant)


def training(folder: Path, progress: Progress = silent) -> Training:
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


def driving(command: float, steps: int) -> UserLearner:
    def learn(env: WatchedEnv, training: Training) -> Constant:
        env.reset()
        for _ in range(steps // env.num_envs):
            env.step(np.full((env.num_envs, 1), command))
        return Constant(command)

    return UserLearner(learn=learn, policy=Constant)


@pytest.mark.parametrize(("command", "success"), [(1.0, 1.0), (-1.0, 0.0)])
def test_its_curve_is_kept_for_it(tmp_path: Path, command: float, success: float) -> None:
    """Forward at 4 m/s every goal, at most 2 m away, is reached in 5 steps; backward none is in 40."""
    told: list[tuple[float, str]] = []
    given = training(tmp_path, lambda share, note: told.append((share, note)))
    _, curve = driving(command, steps=400)(given)
    points = curve["points"]
    assert [point["steps"] for point in points[:3]] == [8, 16, 24] and points[-1]["steps"] == 400 and len(points) == 50
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
        (True, TASK, 1.0, [0.0] * 10 + [1.0]),
        (True, TASK, -1.0, [0.0] * 11),
        (False, TASK, 1.0, [1.0] * 11),
        (True, replace(TASK, objective=Last(horizon=40)), 1.0, [1.0] * 11),
    ],
)
def test_prices_grow_as_in_other_trainings(
    tmp_path: Path, is_plus: bool, task: Task, command: float, expected: list[float]
) -> None:
    given, scales = replace(training(tmp_path), is_plus=is_plus, task=task), list[float]()
    given = replace(given, config=given.config.model_copy(update={"least_success": 0.5}))

    def learn(env: WatchedEnv, training: Training) -> Constant:
        env.reset()
        for _ in range(11):
            # In the end the success that the recipe asks for is enough.
            env.points[:] = [] if len(scales) < 10 else [{"share": 0.45, "success": max(0.0, command) / 2}]
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


class Forgetful(Constant):
    """What its file says is another command."""

    def to_file(self) -> tuple[Mapping[str, torch.Tensor], dict[str, Any]]:
        return {"command": torch.tensor([0.5])}, {"unit": "none"}


class Random(Forgetful):
    def act(self, observation: Any) -> Any:
        return np.random.default_rng().uniform(-1, 1, (len(observation), 1))


def test_a_policy_that_its_file_does_not_hold_is_refused(tmp_path: Path) -> None:
    told = r"^Forgetful.from_file: actions of what it returns are up to 0.25 from those of what learn returned"
    with pytest.raises(BadInputError, match=told):
        UserLearner(learn=lambda *_: Forgetful(0.25), policy=Forgetful)(training(tmp_path))
    UserLearner(learn=lambda *_: Random(0.0), policy=Random)(training(tmp_path))  # of one that draws, nobody knows
    with pytest.raises(BadInputError, match=r"Constant.act: expected finite actions"):
        UserLearner(learn=lambda *_: Constant(math.nan), policy=Constant)(training(tmp_path))


def test_it_may_leave_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)

    def learn(*_: object) -> Constant:
        os.chdir("/")
        return Constant(0.0)

    UserLearner(learn=learn, policy=Constant)(training(tmp_path))
    assert Path.cwd() == tmp_path


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


SEEDS = [7, derive(7, "try 1"), derive(7, "try 2")]


def restarted(
    folder: Path, commands: Iterable[float], progress: Progress = silent, clocks: bool = False, **settings: Any
) -> tuple[float, dict[str, Any], list[int]]:
    """Train policies that give these commands, one a try; return what is kept, the curve and the seeds."""
    rest, seeds = iter(commands), list[int]()

    def learn(env: Any, given: Training) -> Constant:
        assert given.config.total_steps == 4 * 2 ** len(seeds), "each try is twice as long"
        seeds.append(given.seed)
        assert given.folder.is_dir()
        policy = Constant(next(rest))
        observation, _ = env.reset()
        for _ in range(given.config.total_steps // 4):
            observation = env.step(policy.act(observation))[0]
        return policy

    config = PpoTrainConfig(num_envs=4, total_steps=4, data_start_share=0.0, **settings)
    given = replace(training(folder, progress), config=config)
    learner = UserLearner(learn=learn, policy=Constant)

    def timed(given: Training) -> tuple[PolicyFile, dict[str, Any]]:
        kept, curve = learner(given)
        return kept, curve | ({"wall_seconds": 2.0 * len(seeds), "cpu_seconds": len(seeds)} if clocks else {})

    kept, curve = with_restarts(timed, given, None)
    assert isinstance(kept, PolicyFile) and isinstance(kept.policy, UserPolicy)
    return kept.policy.acting.command, curve, seeds  # type: ignore[attr-defined]


def test_a_policy_that_masters_its_simulator_is_kept(tmp_path: Path) -> None:
    command, curve, seeds = restarted(tmp_path, [1.0], tries=3, least_success=1.0)
    assert (command, seeds) == (1.0, SEEDS[:1])
    assert [(one["seed"], one["success"]) for one in curve["tries"]] == [(7, 1.0)]
    assert curve["points"] == curve["tries"][0]["points"]


def test_it_is_trained_again_until_it_does(tmp_path: Path) -> None:
    shares, notes = list[float](), list[str]()

    def progress(share: float, note: str) -> None:
        shares.append(share)
        notes.append(note.partition("  ")[0])

    command, curve, seeds = restarted(tmp_path, [-1.0, 0.9, 1.0], progress, tries=3)
    assert (command, seeds) == (0.9, SEEDS[:2]) and [one["success"] for one in curve["tries"]] == [0.0, 1.0]
    # Forward at 3.75 m/s goals from 1 to 2 m are reached in 3 to 6 steps; backward none in all 40.
    assert curve["tries"][0]["episode_steps"] == 40 and 3 < curve["tries"][1]["episode_steps"] < 6
    assert shares == sorted(shares) and max(shares) == pytest.approx(3 / 7)
    assert sorted(set(notes)) == ["try 1 of 3", "try 2 of 3"] and not (tmp_path / "try_1").exists()


def test_of_those_that_do_not_the_best_is_kept(tmp_path: Path) -> None:
    # At 0.4 m/s, -0.44 of the range, goals up to 1.6 m are in reach within the 4 s of an episode.
    command, curve, seeds = restarted(tmp_path, [-0.9, -0.44, -0.44], tries=3)
    success = [one["success"] for one in curve["tries"]]  # in the same episodes
    assert (command, seeds) == (-0.44, SEEDS) and success[0] < 0.4 < success[1] == success[2] < 0.8


def test_all_tries_cost_time(tmp_path: Path) -> None:
    command, curve, _ = restarted(tmp_path, [-0.44, -1.0, -0.9], tries=3, clocks=True)
    assert command == -0.44 and (curve["wall_seconds"], curve["cpu_seconds"]) == (2 + 4 + 6, 1 + 2 + 3)
    assert "wall_seconds" not in restarted(tmp_path, [-1.0, 1.0], tries=2)[1]
