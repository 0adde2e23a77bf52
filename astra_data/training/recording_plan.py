"""Planned episodes: where to start and what to command, in files that `astra-data collect` takes."""

from collections.abc import Iterator
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, ValidationError
from torch import Tensor

from astra_data.core.config import AtOnce, Config, faults_of
from astra_data.core.errors import BadInputError
from astra_data.worlds.task import Task


class PlannedEpisode(Config):
    """One episode: its start and its commands, which do not depend on the robot's state."""

    start: tuple[float, ...]
    """Abstract state (X,), at rest."""
    commands: tuple[tuple[float, ...], ...] = Field(min_length=1)
    """Successive commands (K, A), in the robot's units."""
    hold_steps: tuple[AtOnce, ...] = Field(min_length=1)
    """Number of steps that each command is held, (K,)."""
    information: float = 0.0
    """How much it is expected to teach, in nats, given the episodes before it in the plan."""


class RecordingPlan(Config):
    """Episodes to record, the most informative first."""

    task: str
    """Name of the task."""
    timestep_s: float
    """Control period."""
    start_names: tuple[str, ...]
    """Names of a start's values."""
    command_names: tuple[str, ...]
    """Names of a command's axes."""
    episodes: tuple[PlannedEpisode, ...] = Field(min_length=1)

    @classmethod
    def load(cls, path: Path | str, task: Task) -> Self:
        """Read a plan of episodes of `task`.

        Raises:
            BadInputError: it is missing, no plan, or of a robot with other states or commands.
        """
        try:
            plan = cls.model_validate_json(Path(path).read_bytes())
        except OSError as error:
            raise BadInputError(f"{path} cannot be read as a plan: {error.strerror}") from None
        except ValidationError as error:
            raise BadInputError(
                f"{path}: expected a plan as `astra-data suggest` writes it: {faults_of(error)}"
            ) from None
        expected = names_of(task)
        if (plan.start_names, plan.command_names) != expected or plan.timestep_s != task.timestep_s:
            raise BadInputError(
                f"{path} is a plan for {plan.task}, with {plan.start_names}, {plan.command_names}, each "
                f"{plan.timestep_s} s: expected {expected[0]}, {expected[1]}, {task.timestep_s} s of "
                f"{task.name}"
            )
        starts, axes = map(len, expected)
        for number, one in enumerate(plan.episodes):
            sizes = {len(one.start) - starts, *(len(command) - axes for command in one.commands)}
            if sizes != {0} or len(one.commands) != len(one.hold_steps):
                raise BadInputError(
                    f"{path}: episode {number}: expected a start of {starts} values, commands of {axes}, and "
                    "how long each is held"
                )
        return plan

    @property
    def starts(self) -> NDArray[np.float64]:
        """The starts of all episodes, (E, X)."""
        return np.array([one.start for one in self.episodes])

    @property
    def longest(self) -> int:
        """Steps of the longest episode."""
        return max(sum(one.hold_steps) for one in self.episodes)

    def actions(self, task: Task) -> Tensor:
        """Return the commands as multiples of ±1, (T, E, A); after its last one an episode holds it."""
        played = np.zeros((self.longest, len(self.episodes), len(self.command_names)), np.float32)
        for number, one in enumerate(self.episodes):
            commands = np.repeat(one.commands, one.hold_steps, axis=0)
            played[: len(commands), number] = commands
            played[len(commands) :, number] = commands[-1]
        return task.limits.normal(torch.from_numpy(played))


class PlannedCommands:
    """A behavior that plays commands whatever the robot does."""

    def __init__(self, action: Tensor) -> None:
        """Play `action` (T, E, A) of ±1, that of all episodes."""
        self._action = action

    def start(self, rows: range, seed: int) -> None:
        """Begin the episodes `rows`; there is nothing random."""
        self._left: Iterator[Tensor] = iter(self._action[:, rows.start : rows.stop])

    def act(self, state: Tensor, goal: Tensor) -> Tensor:
        """Return the actions (B, A) of the next step."""
        return next(self._left)


def names_of(task: Task) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the entries of an abstract state, and of the axes of a command."""
    return task.abstract_state.labels, tuple(task.limits)
