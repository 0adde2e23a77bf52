"""The target made of single robots: anything that can be reset and stepped."""

import inspect
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.core.naming import first_few
from astra_data.core.seeding import derive, generator
from astra_data.dataset.columns import Column
from astra_data.worlds.commands import Commands
from astra_data.worlds.objective import Objective
from astra_data.worlds.protocols import Step, rows_in
from astra_data.worlds.user_code import explained

State = NDArray[np.floating[Any]] | Sequence[float]


class Robot(Protocol):
    """A simulated robot, of which many run side by side; `reset` may take a keyword `seed`, for what is random."""

    def reset(self) -> State:
        """Bring the robot to where an episode starts; return its state (S,)."""

    def step(self, command: Floats) -> tuple[State, bool]:
        """Apply `command` (A,), in its units; return the state (S,) one period later, and if it failed."""


class RobotEnv:
    """B robots, stepped one after another, as a batched target environment; they do not tell of walls."""

    def __init__(
        self,
        objective: Objective,
        num_envs: int,
        *,
        robot: Callable[[], Robot],
        state: Column,
        commands: Commands,
        abstraction: Callable[[Any], Any],
        seed: int,
        num_threads: int | None = None,
        start_anywhere: bool = False,
    ) -> None:
        """Build B robots, with the column of their states, the bounds of their commands, and φ."""
        self.num_envs, self.action_size = num_envs, len(commands)
        self._objective, self._column, self._commands, self._abstraction = objective, state, commands, abstraction
        self._robots = [robot() for _ in range(num_envs)]
        taken = inspect.signature(self._robots[0].reset).parameters
        self._takes_seed = "seed" in taken or any(one.kind is one.VAR_KEYWORD for one in taken.values())
        self._any_end_fails = getattr(self._robots[0], "any_end_fails", False)
        self.goal = torch.zeros(num_envs, objective.goal_size)
        self.failed = torch.zeros(num_envs, dtype=torch.bool)
        self._fell = self.failed.clone()
        self.wall_contact = torch.zeros(num_envs, dtype=torch.bool)
        self._state, self._steps = torch.zeros(num_envs, state.size), [0] * num_envs
        self.reseed(seed)
        self.observation_size = self._observe().shape[1]

    @property
    def state(self) -> Tensor:
        """The robots' states, (B, S) float32."""
        return self._state.clone()

    @property
    def position(self) -> Tensor:
        """What the objective takes from abstract states as positions in the plane, (B, 2 K) float32, m."""
        return self._objective.places(self._abstract())

    def reseed(self, seed: int) -> None:
        """Restart the random numbers at `seed`."""
        self._seed, self._episodes = seed, 0

    def check_commands(self) -> None:
        """Let a robot that has `check_commands` check the bounds of its commands; no robot moves."""
        if check := getattr(self._robots[0], "check_commands", None):
            check(self._commands)

    def reset(self, mask: Tensor | None = None) -> Tensor:
        """Restart the robots in `mask` (B,), by default all; return observations (B, O)."""
        for row in rows_in(mask, self.num_envs).tolist():
            episode = f"episode {self._episodes}"
            self._episodes += 1
            options: dict[str, Any] = {"seed": derive(self._seed, episode)} if self._takes_seed else {}
            with explained("reset of the robot"):
                found = self._robots[row].reset(**options)
            self._steps[row] = 0
            self._state[row] = self._checked(found, "reset", row)
            goal = self._objective.draw_goals(generator(self._seed, f"goal of {episode}"), 1)
            self.goal[row] = torch.from_numpy(goal[0]).float()
            self._fell[row] = self.failed[row] = False
        return self._observe()

    def step(self, action: Tensor, active: Tensor | None = None) -> Step:
        """Apply `action` (B, A) of ±1; robots outside `active` (B,) stay as they are."""
        before = self._abstract()
        commands = self._commands.in_units(action).double().numpy()
        for row in rows_in(active, self.num_envs).tolist():
            with explained("step of the robot"):
                found = self._robots[row].step(commands[row])
            if not isinstance(found, tuple) or len(found) != 2:
                raise BadInputError(f"step of the robot: expected (state, whether it failed), got {found!r}")
            self._steps[row] += 1
            self._state[row], self._fell[row] = self._checked(found[0], "step", row), bool(found[1])
        after = self._abstract()
        reached = self._objective.reached(after, self.goal)
        if self._any_end_fails and (reached & self._fell).any():
            raise BadInputError(
                "step of the robot: its environment terminated in a step that reached the goal, and so the "
                "success counts as a failure: give GymnasiumRobot a failed, a function of the state and of "
                "whether it terminated that returns whether the robot failed"
            )
        success = reached & ~self._fell
        self.failed = (self._fell | self._objective.missed(after, self.goal)) & ~success
        return Step(
            observation=self._observe(),
            reward=self._objective.reward(before, after, self.goal, self.failed),
            terminated=success | self.failed,
            success=success,
        )

    def reset_to(self, rows: NDArray[np.intp], state: Floats) -> None:
        """Refuse with a BadInputError: a robot cannot be set to any state."""
        raise BadInputError("robots cannot be put into a recorded state: expected data_start_share = 0")

    def state_dict(self) -> dict[str, Tensor]:
        """Return what there is to continue from: nothing, robots are where they are."""
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Start new episodes."""
        self.reset()

    def _abstract(self) -> Tensor:
        return torch.as_tensor(self._abstraction(self.state))

    def _observe(self) -> Tensor:
        return self._objective.observe(self._abstract(), self.goal)

    def _checked(self, state: State, call: str, row: int) -> Tensor:
        with explained(f"{call} of the robot: to read its state as numbers"):
            found = torch.as_tensor(np.asarray(state, dtype=np.float32))
        expected = f"{call} of the robot: expected a finite state of {self._column.size} numbers"
        if found.shape != (self._column.size,):
            raise BadInputError(f"{expected}, got {' '.join(repr(state).split())}")
        if lost := (~found.isfinite()).nonzero().flatten().tolist():
            raise BadInputError(
                f"{expected}, got {first_few([self._column.labels[entry] for entry in lost], 4)} = "
                f"{float(found[lost[0]])} after step {self._steps[row]} of an episode of robot {row + 1} of "
                f"{self.num_envs}: see what its simulation does there, or let it fail one step before"
            )
        return found
