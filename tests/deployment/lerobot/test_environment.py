"""Targets as environments of LeRobot, and its command on them."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from astra_data import Dataset
from astra_data.core.errors import BadInputError
from astra_data.pipeline.trained_policy import load_policy, settings_of

FIRST_SEED = 7


@pytest.fixture(scope="module")
def environment() -> Any:
    """The module, which imports LeRobot."""
    import astra_data.deployment.lerobot.environment as environment  # noqa: PLC0415 - takes seconds

    return environment


@pytest.mark.filterwarnings("ignore")
def test_lerobots_own_command_runs_a_policy_and_records_it(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot.scripts.lerobot_eval import eval_main  # noqa: PLC0415 - takes seconds

    options = {
        "env.discover_packages_path": "astra_data.deployment.lerobot",
        "env.type": "astra_data",
        "env.task": settings_of(run)["task"],
        "policy.path": run.with_name("policy"),
        "eval.n_episodes": 2,
        "eval.batch_size": 2,
        "eval.recording": "true",
        "output_dir": tmp_path / "out",
        "seed": FIRST_SEED,
    }
    words = ["lerobot-eval", *(f"--{name}={value}" for name, value in options.items())]
    monkeypatch.setattr(sys, "argv", words)
    eval_main()
    found = json.loads((tmp_path / "out/eval_info.json").read_text())["per_task"][0]["metrics"]
    here = [episode(run, seed) for seed in (FIRST_SEED, FIRST_SEED + 1)]
    assert found["successes"] == [success for success, _ in here]
    np.testing.assert_allclose(found["sum_rewards"], [sum(rewards) for _, rewards in here], atol=1e-3)
    for number, (_, rewards) in enumerate(here):
        recorded = Dataset.open(tmp_path / f"out/recordings/astra_data_0/env_{number}")
        np.testing.assert_allclose(recorded.columns(["next.reward"])["next.reward"], rewards[:-1], atol=1e-4)


def episode(run: Path, seed: int) -> tuple[bool, list[float]]:
    """Return success and rewards of an episode, by the package's own policy and target."""
    policy = load_policy(run, "direct_transfer")
    target = policy.task.target(1, seed=seed)
    target.reset()
    policy.start(1)
    rewards = []
    for _ in range(policy.task.objective.horizon):
        step = target.step(policy.act(target.state, target.goal))
        rewards.append(float(step.reward))
        if step.terminated:
            break
    return bool(step.success), rewards


def test_it_takes_rate_and_sizes_from_the_task(environment: Any, run: Path) -> None:
    config = environment.AstraDataEnv(task=settings_of(run)["task"])
    sizes = {name: feature.shape for name, feature in config.features.items()}
    assert config.fps == 10
    assert sizes == {"observation.state": (2,), "observation.environment_state": (1,), "action": (1,)}
    without_goal = environment.AstraDataEnv(task="recipes/examples/cart/cart.py:TASK")
    assert set(without_goal.features) == {"observation.state", "action"}
    with pytest.raises(BadInputError, match=r"--env\.task: expected a task"):
        environment.AstraDataEnv()
    with pytest.raises(BadInputError, match="task 'cart' has no target"):
        without_goal.create_envs(1)


def test_commands_are_in_their_units_and_the_horizon_ends_episodes(environment: Any, run: Path) -> None:
    env = environment.AstraDataEnv(task=settings_of(run)["task"]).create_envs(2)["astra_data"][0]
    robot = env.envs[0].unwrapped
    assert (robot.action_space.low, robot.action_space.high) == (-1.0, 4.0)
    first, _ = env.reset(seed=[3, 3])
    assert (first["observation.environment_state"][0] == first["observation.environment_state"][1]).all()
    again, _ = env.reset(seed=[4, 3])
    assert again["observation.environment_state"][0] != first["observation.environment_state"][0]
    assert again["observation.environment_state"][1] == first["observation.environment_state"][1]
    for number in range(1, 41):
        shown, _, terminated, truncated, info = env.step(np.array([[0.25], [0.0]], np.float32))
        np.testing.assert_allclose(shown["observation.state"][0], [0.0225 * number, 0.25], atol=1e-5)
        assert truncated.tolist() == [number == 40] * 2
    assert not terminated.any() and not info["is_success"].any()
    assert env.call("task_description") == ("rail-cart", "rail-cart")
    assert env.call("_max_episode_steps") == (40, 40) and robot.metadata["render_fps"] == 10
    assert env.envs[0].render().shape == (64, 64, 3)
    ended, reward, *_ = env.step(np.array([[4.0], [4.0]], np.float32))
    np.testing.assert_allclose(ended["observation.state"], shown["observation.state"])
    assert not reward.any()
    robot.reset(seed=3)
    assert robot.step(np.zeros(1, np.float32))[3] is False  # it is not cut off again


def test_a_push_to_the_goal_is_a_success_and_one_that_tips_is_none(environment: Any, run: Path) -> None:
    env = environment.AstraDataEnv(task=settings_of(run)["task"]).create_envs(2)["astra_data"][0]
    env.reset(seed=[0, 1])
    _, _, terminated, _, info = env.step(np.array([[2.9], [3.1]], np.float32))
    assert terminated.tolist() == [False, True]
    for _ in range(8):
        _, _, terminated, _, info = env.step(np.array([[2.9], [0.0]], np.float32))
        if terminated[0]:
            break
    assert info["is_success"].tolist() == [True, False]
