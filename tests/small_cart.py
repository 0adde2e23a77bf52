"""A task of a user's own, as short as one can be: a cart on a rail that tips when it is pushed hard."""

from typing import Any

import numpy as np
import torch

from astra_data import Column, Objective, Task


class Rail:
    """Carts [x] that move as they are told."""

    abstract_state = Column("abstract.state", size=1, names=("x",))
    parameters = {"timestep_s": 0.1}  # noqa: RUF012 - as a user would write it

    def __init__(self, num_envs: int) -> None:
        self.state = torch.zeros(num_envs, 1)

    @staticmethod
    def abstraction(state: Any) -> Any:
        return state[..., :1]

    def reset_to(self, state: torch.Tensor, rows: torch.Tensor | None = None) -> None:
        self.state = state.clone() if rows is None else self.state.index_copy(0, rows, state)

    def step(self, command: torch.Tensor) -> torch.Tensor:
        self.state = self.state + 0.1 * command
        return self.state


class Reach(Objective):
    """Get to the goal on the rail."""

    action_size, goal_size = 1, 1

    def draw_starts(self, rng: np.random.Generator, count: int) -> Any:
        return np.zeros((count, 1))

    def draw_goals(self, rng: np.random.Generator, count: int) -> Any:
        return rng.uniform(1.0, 2.0, (count, 1))

    def reached(self, state: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        return state[:, 0] >= goal[:, 0]

    def reward(
        self, before: torch.Tensor, after: torch.Tensor, goal: torch.Tensor, failed: torch.Tensor
    ) -> torch.Tensor:
        ends = 10.0 * (self.reached(after, goal) & ~failed) - 10.0 * failed
        return after[:, 0] - before[:, 0] + ends


class Near(Reach):
    """Get 0.3 m ahead."""

    def draw_goals(self, rng: np.random.Generator, count: int) -> Any:
        return np.full((count, 1), 0.3)


class Last(Reach):
    """To be on the rail until the end is all that is asked."""

    is_lasting = True


class Cart:
    """The robot: [x, speed]; a push by more than 3 m/s at once tips it."""

    def reset(self) -> list[float]:
        self.x = self.speed = 0.0
        return [self.x, self.speed]

    def step(self, command: np.ndarray[Any, Any]) -> tuple[list[float], bool]:
        tips = abs(float(command[0]) - self.speed) > 3.0
        self.speed = float(command[0])
        self.x += 0.09 * self.speed
        return [self.x, self.speed], tips


GIVEN: dict[str, Any] = {
    "name": "rail-cart",
    "timestep_s": 0.1,
    "state": Column("observation.state", size=2, names=("x", "speed")),
    "commands": {"v": (-1.0, 4.0)},
    "make_simulator": Rail,
    "objective": Reach(horizon=40),
}
TASK = Task(**GIVEN, robot=Cart)
LOGS_ALONE = Task(**GIVEN)
