"""A task: target environment, abstract simulator, the map between their states, and the objective."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Column
from astra_data.worlds.batched import TargetEnv
from astra_data.worlds.objective import Objective
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.protocols import TaskSimulator, VariableSimulator
from astra_data.worlds.variation import Variation, VariedSimulator


class MakeSimulator(Protocol):
    """Builds B abstract simulators."""

    def __call__(self, num_envs: int, *, device: str) -> TaskSimulator:
        """Build `num_envs` simulators."""
        ...


@dataclass(frozen=True)
class Varied:
    """How the parameters of an abstract simulator vary from episode to episode.

    Attributes:
        kind: of simulator whose parameters vary; built from a plain one and the ranges.
        randomized: what domain randomization varies, in which ranges.
        wide: what COMPASS varies or identifies, and RMA adapts to; its kind is that of all parameters that
            the simulator has.
    """

    kind: Callable[[VariableSimulator, Variation], VariedSimulator]
    randomized: Variation
    wide: Variation


@dataclass(frozen=True)
class Plane:
    """Properties that only tasks in a maze have.

    Attributes:
        wall_reach_m: a robot whose clearance in the maze is larger than this touches no wall.
    """

    wall_reach_m: float


@dataclass(frozen=True)
class Task:
    """A problem of abstract sim2real.

    Attributes:
        name: in recipes. instruction: LeRobot's task description.
        objective: horizon, reward and success; the maze, if there is one.
        make_target, make_simulator: build the target environment and the abstract simulator.
        abstraction: φ, target states (..., S) to abstract states (..., X).
        beyond: the part of target states that φ drops, scaled to about 1, (..., S) to (..., R).
        state_columns: the columns that hold states, goal and action, with units, frames and roles.
        abstract_state: the column of abstract states, likewise.
        timestep_s: the control period.
        action_limit: largest action along each axis; target and simulator clip actions to it.
        quantities: indices in abstract states of what the gap report lists, by name with unit.
        facts: what datasets record about the target environment.
        simulator_id: names the abstract simulator in datasets.
        varied: the same simulator with parameters that vary.
        plane: properties of a task in a maze; None for others.
        photograph: renders target states (K, S) as pictures (K, height, width, 3); None where reports show
            none.
        target_id: name of a target that several tasks share, so that episodes of one serve all.

    Example:
        >>> from astra_data import TASKS
        >>> task = TASKS["antmaze-umaze"]
        >>> task.fps, task.abstract_state.names
        (20, ('x', 'y', 'vx', 'vy'))
        >>> task.simulator(4).state.shape  # (B, X)
        torch.Size([4, 4])
    """

    name: str
    instruction: str
    objective: Objective
    make_target: Callable[..., TargetEnv]
    make_simulator: MakeSimulator
    abstraction: Callable[[Any], Any]
    beyond: Callable[[Tensor], Tensor]
    state_columns: tuple[Column, ...]
    abstract_state: Column
    timestep_s: float
    action_limit: float
    quantities: Mapping[str, tuple[int, ...]]
    simulator_id: str
    facts: Mapping[str, str | float]
    varied: Varied
    plane: Plane | None = None
    photograph: Callable[[NDArray[np.float64]], NDArray[np.uint8]] | None = None
    target_id: str | None = None

    def shares_target(self, other: "Task") -> bool:
        """Return whether both tasks have the same target and differ only in the simulator."""
        return self.target_id is not None and self.target_id == other.target_id

    @property
    def planar(self) -> Plane:
        """The properties of a task in a maze.

        Raises:
            BadInputError: the task has no maze.
        """
        if self.plane is None:
            raise self.without_maze()
        return self.plane

    @property
    def maze(self) -> Maze:
        """The maze.

        Raises:
            BadInputError: the task has no maze.
        """
        if self.objective.layout is None:
            raise self.without_maze()
        return self.objective.layout

    def without_maze(self) -> BadInputError:
        """Return the error for settings that need a maze."""
        return BadInputError(
            f"expected a task in a maze, got '{self.name}', which has none: leave out the settings that need "
            "one (augment, follower, support_penalty, command_limit_m_s, "
            "clearance_m, start 'anywhere')"
        )

    @property
    def ball_index(self) -> int | None:
        """Index in abstract states of the ball's x; None where there is no ball."""
        ball = self.quantities.get("ball_position_m")
        return ball[0] if ball else None

    @property
    def fps(self) -> int:
        """Control steps per second, rounded, for LeRobot takes whole numbers."""
        return round(1.0 / self.timestep_s)

    def target(self, num_envs: int, **options: Any) -> TargetEnv:  # noqa: ANN401 - handed on
        """Build `num_envs` target environments; `options` are the environment's own."""
        return self.make_target(self.objective, num_envs, **options)

    def simulator(self, num_envs: int, device: str = "cpu") -> TaskSimulator:
        """Build `num_envs` abstract simulators."""
        return self.make_simulator(num_envs, device=device)

    def varied_simulator(self, num_envs: int, variation: Variation, device: str = "cpu") -> VariedSimulator:
        """Build `num_envs` abstract simulators whose parameters vary; those without a range are plain."""
        ranges = type(self.varied.wide)(**variation.model_dump())
        return self.varied.kind(self.simulator(num_envs, device), ranges)


def roles(
    names: tuple[str, ...],
    units: list[str],
    frames: list[str],
    entries: list[str],
    mirror: list[str] | None = None,
) -> dict[str, Any]:
    """Return a `Column`'s arguments on its entries: names, units, frames, roles and mirror images."""
    astra = {"unit": units, "frame": frames, "role": entries}
    return {"names": names, "astra": astra if mirror is None else {**astra, "mirror": mirror}}
