"""What a task is: a target environment, an abstract simulator, the map between them, and what to achieve."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from astra_data.batched import TargetEnv
from astra_data.columns import Column
from astra_data.mazes import Maze
from astra_data.objective import Objective
from astra_data.planar import VariedStates
from astra_data.simulator import PairedSimulator
from astra_data.variation import Variation


class MakeSimulator(Protocol):
    """Builds B abstract simulators."""

    def __call__(self, maze: Maze, num_envs: int, *, timestep_s: float, device: str) -> PairedSimulator:
        """Build `num_envs` simulators in `maze`."""
        ...


class MakeVariedSimulator(Protocol):
    """Builds B abstract simulators whose parameters vary."""

    def __call__(
        self, maze: Maze, num_envs: int, variation: Variation, *, timestep_s: float, device: str
    ) -> VariedStates:
        """Build `num_envs` simulators in `maze`."""
        ...


@dataclass(frozen=True)
class Task:
    """A problem of abstract sim2real.

    Attributes:
        name: in recipes. instruction: what LeRobot calls the task.
        objective: maze, horizon, reward and success.
        make_target, make_simulator, make_varied_simulator: the worlds.
        abstraction: φ, target states (..., S) to abstract states (..., X).
        beyond: what φ drops of target states, scaled to a length of about one, (..., S) to (..., S - X).
        state_columns: the columns that hold states, goal and action, with units, frames and roles.
        abstract_state: the column of abstract states, likewise.
        timestep_s: the control period.
        action_limit: largest action along each axis; both worlds cut off what is beyond.
        wall_reach_m: a robot whose clearance in the maze is larger than this touches no wall.
        is_mirrorable: whether the robot, its controller included, is its own mirror image.
        ranges: of the simulator's parameters, as the paper prints them for COMPASS.
        facts: what datasets record about the target environment.
        simulator_id: names the abstract simulator in datasets.
    """

    name: str
    instruction: str
    objective: Objective
    make_target: Callable[..., TargetEnv]
    make_simulator: MakeSimulator
    make_varied_simulator: MakeVariedSimulator
    abstraction: Callable[[Any], Any]
    beyond: Callable[[Tensor], Tensor]
    state_columns: tuple[Column, ...]
    abstract_state: Column
    timestep_s: float
    action_limit: float
    wall_reach_m: float
    is_mirrorable: bool
    ranges: Variation
    simulator_id: str
    facts: Mapping[str, str | float]

    @property
    def maze(self) -> Maze:
        """The maze."""
        return self.objective.maze

    @property
    def fps(self) -> int:
        """Control steps per second, rounded: LeRobot's are whole numbers."""
        return round(1.0 / self.timestep_s)

    def target(self, num_envs: int, **options: Any) -> TargetEnv:  # noqa: ANN401 - handed on
        """Build `num_envs` target environments; `options` are the environment's own."""
        return self.make_target(self.objective, num_envs, **options)

    def simulator(self, num_envs: int, device: str = "cpu") -> PairedSimulator:
        """Build `num_envs` abstract simulators."""
        return self.make_simulator(self.maze, num_envs, timestep_s=self.timestep_s, device=device)

    def varied_simulator(self, num_envs: int, variation: Variation, device: str = "cpu") -> VariedStates:
        """Build `num_envs` abstract simulators whose parameters vary."""
        return self.make_varied_simulator(
            self.maze, num_envs, variation, timestep_s=self.timestep_s, device=device
        )


def roles(
    names: tuple[str, ...],
    units: list[str],
    frames: list[str],
    entries: list[str],
    mirror: list[str] | None = None,
) -> dict[str, Any]:
    """Return what a `Column` is told of its entries: names, units, frames, roles and mirror images."""
    astra = {"unit": units, "frame": frames, "role": entries}
    return {"names": names, "astra": astra if mirror is None else {**astra, "mirror": mirror}}
