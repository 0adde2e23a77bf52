from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from small_cart import TASK, Cart, Near, Reach

from astra_data.core.errors import BadInputError
from astra_data.policies.episodes import in_target


def test_robots_are_stepped_by_commands_in_their_units() -> None:
    learned = torch.ones(1, requires_grad=True)
    env = replace(TASK, abstraction=lambda state: state[..., :1] * learned).target(3, seed=0)
    env.reset()
    step = env.step(torch.tensor([[-1.0], [0.6], [1.0]]))
    # The middle is 1.5, half the range 2.5: -1, 3 and 4 m/s; the third is pushed too hard.
    torch.testing.assert_close(env.state, torch.tensor([[-0.09, -1.0], [0.27, 3.0], [0.36, 4.0]]))
    assert env.failed.tolist() == step.terminated.tolist() == [False, False, True]
    torch.testing.assert_close(step.reward, torch.tensor([-0.09, 0.27, 0.36 - 10.0]))
    assert not step.success.any() and not env.wall_contact.any() and not step.reward.requires_grad


def test_a_robot_that_fails_at_its_goal_does_not_succeed() -> None:
    env = replace(TASK, objective=Near(horizon=40)).target(1, seed=0)
    env.reset()
    step = env.step(torch.tensor([[1.0]]))  # to 0.36 m, pushed too hard
    assert step.terminated.all() and env.failed.all() and not step.success.any()


class Edge(Reach):
    """A rail that ends at -0.2 m."""

    def missed(self, state: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        return state[:, 0] < -0.2


def test_what_the_objective_misses_is_a_failure_until_the_next_episode() -> None:
    env = replace(TASK, objective=Edge(horizon=40)).target(2, seed=0)
    env.reset()
    back = torch.tensor([[-1.0], [-0.6]])
    ended = [env.step(back).terminated.tolist() for _ in range(3)]
    assert ended == [[False, False], [False, False], [True, False]] and env.failed.tolist() == [True, False]
    # A robot that is done stays where it is, and failed.
    assert env.step(back, torch.tensor([False, True])).terminated.tolist() == [True, False]
    env.reset(torch.tensor([True, False]))
    assert env.failed.tolist() == [False, False]
    fell = env.step(torch.tensor([[1.0], [-0.6]]))
    assert fell.terminated.tolist() == [True, False] and env.failed.tolist() == [True, False]
    found = in_target(replace(TASK, objective=Edge(horizon=40)), lambda goal: driving_back, 3, seed=0)
    assert found.failed == [1.0] * 3 and found.success == [0.0] * 3 and found.steps == [3] * 3


def driving_back(state: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    return torch.full_like(goal, -1.0)


class Noted(Cart):
    """A robot that notes its seeds."""

    seeds: list[int] = []  # noqa: RUF012 - shared on purpose

    def reset(self, seed: int = -1) -> list[float]:
        self.seeds.append(seed)
        return super().reset()


class NotedAmongOptions(Noted):
    def reset(self, **options: Any) -> list[float]:  # type: ignore[override]
        return super().reset(**options)


@pytest.mark.parametrize("robot", [Noted, NotedAmongOptions])
def test_the_same_seed_gives_the_same_goals_and_seeds(robot: type[Noted]) -> None:
    task, goals = replace(TASK, robot=robot), []
    Noted.seeds.clear()
    for seed in (1, 1, 2):
        env = task.target(2, seed=seed)
        env.reset()
        goals.append(env.goal.tolist())
    env.reseed(1)
    env.reset()
    goals.append(env.goal.tolist())
    assert goals[0] == goals[1] == goals[3] != goals[2] and goals[0][0] != goals[0][1]
    assert Noted.seeds[:2] == Noted.seeds[2:4] == Noted.seeds[6:] != Noted.seeds[4:6] and -1 not in Noted.seeds


@pytest.mark.parametrize("state", [[0.0], [0.0, float("nan")], [0.0, 0.0, 0.0], None])
def test_a_state_of_another_kind_is_refused(state: Any) -> None:
    class Broken(Cart):
        def step(self, command: np.ndarray[Any, Any]) -> tuple[Any, bool]:
            return state, False

    env = replace(TASK, robot=Broken).target(1, seed=0)
    env.reset()
    with pytest.raises(BadInputError, match="step of the robot: expected a finite state of 2 numbers, got"):
        env.step(torch.zeros(1, 1))


def test_the_step_in_which_a_state_is_lost_is_told() -> None:
    class Lost(Cart):
        steps = 0

        def step(self, command: np.ndarray[Any, Any]) -> Any:
            self.steps += 1
            (x, speed), tips = super().step(command)
            return np.array([[x, np.inf if self.steps > 3 and speed > 0 else speed]])[0], tips

    env = replace(TASK, robot=Lost).target(3, seed=0)
    env.reset()
    for steps in range(1, 4):
        env.step(torch.full((3, 1), -0.6))
        if steps == 1:
            env.reset(torch.tensor([False, False, True]))
    told = r"got speed = inf after step 3 of an episode of robot 3 of 3: see what"
    with pytest.raises(BadInputError, match=told) as caught:
        env.step(torch.tensor([[-0.6], [-0.6], [0.0]]))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("found", [[0.0, 1.0], np.zeros(2), None, ([0.0, 1.0], False, {})])
def test_a_step_that_does_not_say_whether_it_failed_is_refused(found: object, monkeypatch: pytest.MonkeyPatch) -> None:
    env = TASK.target(1, seed=0)
    monkeypatch.setattr(Cart, "step", lambda _cart, _command: found)
    with pytest.raises(BadInputError, match=r"step of the robot: expected \(state, whether it failed\), got "):
        env.step(torch.zeros(1, 1))
