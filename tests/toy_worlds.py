"""Batched environments so small that what a learner should make of them is known."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from astra_data.core.checkpoint import Logbook
from astra_data.policies.learner import Learner
from astra_data.worlds.protocols import Step


class _World:
    """B rows of a state (B, X) and nothing else."""

    action_size = 1
    observation_size: int

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.state = self.draw()

    def draw(self) -> Tensor:
        raise NotImplementedError

    def observe(self) -> Tensor:
        return self.state.clone()

    def reset(self, mask: Tensor | None = None) -> Tensor:
        new = self.draw()
        self.state = new if mask is None else torch.where(mask[:, None], new, self.state)
        return self.observe()

    def outcome(self, reward: Tensor, terminated: Tensor) -> Step:
        return Step(self.observe(), reward, terminated, terminated)

    def state_dict(self) -> dict[str, Tensor]:
        return {"state": self.state}

    def load_state_dict(self, state: dict[str, Tensor]) -> Tensor:
        self.state = state["state"].clone()
        return self.observe()


class GoToZero(_World):
    """A point in [-1, 1] moves by 0.2 times the action; each step costs its squared distance to 0."""

    observation_size = 1

    def draw(self) -> Tensor:
        return torch.rand(self.num_envs, 1) * 2 - 1

    def step(self, action: Tensor) -> Step:
        self.state = (self.state + 0.2 * action.clamp(-1.0, 1.0)).clamp(-1.0, 1.0)
        return self.outcome(-self.state[:, 0].square(), torch.zeros(self.num_envs, dtype=torch.bool))


class ConstantReward(_World):
    """One unit of reward each step, whatever is done; terminates after `length` steps."""

    observation_size = 1

    def __init__(self, num_envs: int, length: float) -> None:
        self.length = length
        super().__init__(num_envs)

    def draw(self) -> Tensor:
        return torch.zeros(self.num_envs, 1)

    def observe(self) -> Tensor:
        return torch.ones(self.num_envs, 1)

    def step(self, action: Tensor) -> Step:
        self.state = self.state + 1.0
        return self.outcome(torch.ones(self.num_envs), self.state[:, 0] >= self.length)


class Recall(_World):
    """A sign is shown in the first of three steps and has to be acted out in the last."""

    observation_size = 2

    def draw(self) -> Tensor:
        sign = torch.randint(2, (self.num_envs, 1)) * 2.0 - 1.0
        return torch.cat([sign, torch.zeros_like(sign)], dim=1)

    def observe(self) -> Tensor:
        sign, age = self.state.unbind(1)
        return torch.stack([sign * (age == 0), (age == 2).float()], dim=1)

    def step(self, action: Tensor) -> Step:
        sign, age = self.state.unbind(1)
        reward = action[:, 0].clamp(-1.0, 1.0) * sign * (age == 2)
        self.state = torch.stack([sign, age + 1], dim=1)
        return self.outcome(reward, age == 2)


class Slope(_World):
    """A ramp rises by a hidden slope each step; the last value of an observation tells the slope.

    Actions do nothing. Height and slope have zero mean, so that one height alone tells little.
    """

    observation_size = 2

    def draw(self) -> Tensor:
        height, slope = torch.randn(self.num_envs), torch.rand(self.num_envs) * 2 - 1
        return torch.stack([height, slope], dim=1)

    def step(self, action: Tensor) -> Step:
        self.state = torch.stack([self.state[:, 0] + 0.02 * self.state[:, 1], self.state[:, 1]], dim=1)
        return self.outcome(torch.zeros(self.num_envs), torch.zeros(self.num_envs, dtype=torch.bool))


class EndsAtZero(GoToZero):
    """As `GoToZero`, but episodes end near 0; `steps` keeps what was returned."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs)
        self.steps: list[Step] = []

    def step(self, action: Tensor) -> Step:
        super().step(action)
        self.steps.append(self.outcome(-self.state[:, 0].square(), self.state[:, 0].abs() < 0.15))
        return self.steps[-1]


def train(learner: Learner) -> list[dict[str, float]]:
    """Return the figures of all iterations."""
    metrics = []
    while not learner.done:
        metrics.append(learner.iterate())
    return metrics


def came_back(state: dict[str, Any]) -> dict[str, Any]:
    """Return what a training that resumes from `state` is given."""
    read: dict[str, Any] = {}
    with TemporaryDirectory() as folder:
        Logbook(Path(folder) / "checkpoint.pt", read.update).keep(state)
        Logbook(Path(folder) / "checkpoint.pt", read.update)
    return read


def assert_resumes(begin: Callable[[], Any], learned: str = "policy") -> None:
    """Training goes on to the same parameters, to the bit, after half of its steps from what the disk gives back."""
    whole, begun, resumed = begin(), begin(), begin()
    train(whole)
    while begun.share < 0.5:
        begun.iterate()
    saved = came_back({"learner": begun.state_dict(), "world": begun.env.state_dict()})
    begun.iterate()  # goes on elsewhere; must not reach into what was saved
    resumed.load_state_dict(saved["learner"], resumed.env.load_state_dict(saved["world"]))
    assert resumed.steps == whole.steps / 2
    train(resumed)
    found = getattr(resumed, learned).state_dict()
    for name, value in getattr(whole, learned).state_dict().items():
        assert torch.equal(value, found[name]), name
