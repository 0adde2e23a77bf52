"""A task: target environment, abstract simulator, the map between their states, and the objective."""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from astra_data.core.arrays import Floats
from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch, without_gradients
from astra_data.core.naming import first_few
from astra_data.core.seeding import derive, generator
from astra_data.dataset.columns import ABSTRACT_STATE, ACTION, GOAL, NEXT_STATE, STATE, Column
from astra_data.dataset.description import NAME
from astra_data.worlds.commands import Commands, DrivenSimulator, VariedCommands
from astra_data.worlds.objective import Objective
from astra_data.worlds.plane.mazes import Maze
from astra_data.worlds.protocols import AbstractSimulator, Step, TargetEnv, TaskSimulator, rows_in
from astra_data.worlds.user_code import explained
from astra_data.worlds.variation import RANDOMIZED_COMMANDS, Variation, VariedSimulator

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
        self, task: "Task", num_envs: int, *, seed: int, num_threads: int | None = None, start_anywhere: bool = False
    ) -> None:
        """Build B robots of `task`."""
        assert task.robot is not None
        self.num_envs, self.action_size = num_envs, len(task.limits)
        self._task, self._objective = task, task.objective
        self._robots = [task.robot() for _ in range(num_envs)]
        taken = inspect.signature(self._robots[0].reset).parameters
        self._takes_seed = "seed" in taken or any(one.kind is one.VAR_KEYWORD for one in taken.values())
        self._any_end_fails = getattr(self._robots[0], "any_end_fails", False)
        self.goal = torch.zeros(num_envs, self._objective.goal_size)
        self.failed = torch.zeros(num_envs, dtype=torch.bool)
        self._fell = self.failed.clone()
        self.wall_contact = torch.zeros(num_envs, dtype=torch.bool)
        self._state, self._steps = torch.zeros(num_envs, task.state.size), [0] * num_envs
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
            check(self._task.limits)

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
        commands = self._task.limits.in_units(action).double().numpy()
        for row in rows_in(active, self.num_envs).tolist():
            with explained("step of the robot"):
                found = self._robots[row].step(commands[row])
            if not isinstance(found, tuple) or len(found) != 2:
                raise BadInputError(f"step of the robot: expected (state, whether it failed), got {found!r}")
            state, fell = found
            if fell not in (True, False):
                raise BadInputError(f"step of the robot: expected True or False for whether it failed, got {fell!r}")
            self._steps[row] += 1
            self._state[row], self._fell[row] = self._checked(state, "step", row), bool(fell)
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
        reward = self._objective.reward(before, after, self.goal, self.failed)
        return Step(self._observe(), reward, terminated=success | self.failed, success=success)

    def reset_to(self, rows: NDArray[np.intp], state: Floats) -> None:
        """Refuse with a BadInputError: a robot cannot be set to any state."""
        raise BadInputError("robots cannot be put into a recorded state: expected data_start_share = 0")

    def state_dict(self) -> dict[str, Tensor]:
        """Return what there is to continue from: nothing, robots are where they are."""
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Start new episodes."""
        self.reset()

    @without_gradients
    def _abstract(self) -> Tensor:
        return torch.as_tensor(self._task.abstraction(self.state))

    def _observe(self) -> Tensor:
        return self._objective.observe(self._abstract(), self.goal)

    def _checked(self, state: State, call: str, row: int) -> Tensor:
        with explained(f"{call} of the robot: to read its state as numbers"):
            found = torch.as_tensor(np.asarray(state, dtype=np.float32))
        expected = f"{call} of the robot: expected a finite state of {self._task.state.size} numbers"
        if found.shape != (self._task.state.size,):
            raise BadInputError(f"{expected}, got {' '.join(repr(state).split())}")
        if lost := (~found.isfinite()).nonzero().flatten().tolist():
            raise BadInputError(
                f"{expected}, got {first_few([self._task.state.labels[entry] for entry in lost], 4)} = "
                f"{float(found[lost[0]])} after step {self._steps[row]} of an episode of robot {row + 1} of "
                f"{self.num_envs}: see what its simulation does there, or let it fail one step before"
            )
        return found


class ColumnEntry(NamedTuple):
    """One value of a column, in the words of `Column.astra`."""

    name: str
    unit: str
    frame: str
    role: str


def entries(names: str, unit: str, frame: str, role: str) -> tuple[ColumnEntry, ...]:
    """Return an entry for each of `names`, which are apart by blanks; unit, frame and role are the same."""
    return tuple(ColumnEntry(name, unit, frame, role) for name in names.split())


PLANAR_STATE = (*entries("x y", "m", "world", "position"), *entries("vx vy", "m/s", "world", "vector"))
"""Abstract states of a robot in the plane."""
PLANAR_GOAL = entries("goal_x goal_y", "m", "world", "position")


def column(name: str, values: Sequence[ColumnEntry], meaning: str) -> Column:
    """Return the column `name` with `values`."""
    names, units, frames, roles = zip(*values, strict=True)
    astra = {"unit": [*units], "frame": [*frames], "role": [*roles]}
    return Column(name, size=len(values), names=names, meaning=meaning, astra=astra)


def names_with_units(column: Column) -> list[str]:
    """Return the names of a column's values, with units where these are known: "speed_m_s"."""
    words = ["_".join(re.findall("[a-z0-9]+", unit.replace("²", "2").replace("°", "deg"))) for unit in column.units]
    return [
        name if word in ("", "1") or name.endswith(f"_{word}") else f"{name}_{word}"
        for name, word in zip(column.labels, words, strict=True)
    ]


def free_body(joints: Sequence[str]) -> list[ColumnEntry]:
    """Return the entries of MuJoCo's qpos, then qvel, of a free body with hinge `joints`, in their order."""
    rates = " ".join(f"{joint}_rate" for joint in joints)
    return [
        *entries("x y", "m", "world", "position"),
        ColumnEntry("z", "m", "world", "invariant"),
        *entries("qw qx qy qz", "1", "world", "quaternion"),
        *entries(" ".join(joints), "rad", "joint", "invariant"),
        *entries("vx vy", "m/s", "world", "vector"),
        ColumnEntry("vz", "m/s", "world", "invariant"),
        *entries("wx wy wz", "rad/s", "body", "invariant"),
        *entries(rates, "rad/s", "joint", "invariant"),
    ]


def whole(state: Tensor) -> Tensor:
    """Return target states (..., S) as they are."""
    return state


@dataclass(frozen=True)
class Varied:
    """How the parameters of an abstract simulator vary from episode to episode."""

    kind: Callable[[TaskSimulator, Variation], VariedSimulator]  # builds it from a plain one and the ranges
    randomized: Variation  # what domain randomization varies, in which ranges
    wide: Variation  # what COMPASS varies or identifies, and RMA adapts to, of the kind of all parameters


_KINDS: tuple[tuple[str, Any, str], ...] = (
    ("name", str, "a text"),
    ("timestep_s", Real, "a number of seconds"),
    ("commands", Mapping | str | Path, "(least, largest) by name, or a dataset"),
    ("objective", Objective, "an object of a class that derives from astra_data.Objective"),
)  # of what the rest of a task is made from
_DERIVED: Any = None  # from other fields
_BALL = "ball_position_m"  # the quantity of what the robot kicks or pushes


@dataclass(frozen=True, kw_only=True)
class Task:
    """A problem of abstract sim2real. Six fields must be given; the others have defaults.

    Attributes:
        name: in datasets, results and, of tasks of the package, in recipes.
        state: the column of target states, with names, units, frames and roles.
        commands: (least, largest) command by name of each axis of the action; or a dataset, whose range they are.
        make_simulator: the class of the abstract simulator, a `Simulator`, or what builds B of them.
        objective: horizon, starts, goals, reward and success; the maze, if there is one.
        robot: builds one robot; or make_target: builds B target environments. A task may have neither.
        instruction: LeRobot's task description, by default the name.
        action, goal: their columns, by default with the names of `commands`, and without names.
        abstraction: φ, target states (..., S) to abstract states (..., X), by default the simulator's.
        abstract_state: the column of abstract states, by default the simulator's.
        beyond: what φ drops, scaled to about 1, (..., S) to (..., R); by default the whole state.
        quantities: indices in abstract states of what the gap report lists, by name with unit; by default each.
            `ball_position_m`, x and y, is of what the robot, whose x and y come first, kicks or pushes: corrections
            see how far it is; `ball_velocity_m_s`, if it ends the state, how it rolls.
        facts: what datasets record about the target environment.
        simulator_id: names the abstract simulator in datasets, by default after its class.
        varied: the same simulator with parameters that vary, by default what reaches it of the commands.
        wall_reach_m: a robot whose clearance in the maze is larger than this touches no wall.
        target_id: name of a target that several tasks share, so that episodes of one serve all.
        derived: the defaults that were filled in, by field: `dataclasses.replace` fills them in anew.

    Example:
        >>> from astra_data import TASKS
        >>> task = TASKS["antmaze-umaze"]
        >>> task.fps, task.abstract_state.names
        (20, ('x', 'y', 'vx', 'vy'))
        >>> task.simulator(4).state.shape  # (B, X)
        torch.Size([4, 4])
    """

    name: str
    timestep_s: float
    state: Column
    commands: Mapping[str, tuple[float, float]] | str | Path
    make_simulator: Callable[..., AbstractSimulator]
    objective: Objective
    robot: Callable[[], Robot] | None = None
    make_target: Callable[..., TargetEnv] | None = None
    instruction: str = ""
    action: Column = _DERIVED
    goal: Column | None = None
    abstraction: Callable[[Any], Any] = _DERIVED
    abstract_state: Column = _DERIVED
    beyond: Callable[[Tensor], Tensor] = whole
    quantities: Mapping[str, tuple[int, ...]] = _DERIVED
    facts: Mapping[str, str | float] = field(default_factory=dict)
    simulator_id: str = ""
    varied: Varied = Varied(VariedCommands, RANDOMIZED_COMMANDS, RANDOMIZED_COMMANDS)
    wall_reach_m: float = 0.0
    target_id: str | None = None
    derived: Mapping[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        for one in fields(self):
            if one.name in self.derived and getattr(self, one.name) is self.derived[one.name]:
                object.__setattr__(self, one.name, one.default)
        for name, kind, expected in _KINDS:
            if not isinstance(given := getattr(self, name), kind):
                raise BadInputError(f"task: {name}: expected {expected}, got {given!r}")
        if not hasattr(self.objective, "action_size"):
            raise BadInputError(f"task: {_named(self.objective)}: expected an action_size, the number of commands")
        made = self.make_simulator
        while isinstance(made, partial):
            made = made.func
        faults = [
            f"make_simulator: {_named(made)} has no {name}; give the task one, or the class"
            for name in ("abstraction", "abstract_state")
            if getattr(self, name) is None and not hasattr(made, name)
        ]
        bounds = self.commands
        commands = Commands.recorded(bounds) if isinstance(bounds, str | Path) else Commands(bounds)
        if (size := self.objective.action_size) != len(commands):
            faults.append(f"objective: action_size {size}, expected that of commands, {len(commands)}")
        if self.action and {*self.action.labels} == {*commands} and self.action.labels != (*commands,):
            faults.append(f"action: names {', '.join(self.action.labels)}, expected {', '.join(commands)}")
        simulated = self.abstract_state or getattr(made, "abstract_state", None)
        named = {"state": self.state, "action": self.action, "goal": self.goal, "abstract_state": simulated}
        for name, column in named.items():
            names = (column and column.names) or ()
            if repeated := sorted({entry for entry in names if names.count(entry) > 1}):
                faults.append(f"{name}: names has {', '.join(repeated)} more than once")
        for name, size in (("action", len(commands)), ("goal", self.objective.goal_size)):
            if (column := getattr(self, name)) and column.size != size:
                faults.append(f"{name}: {column.size} values, expected {size}")
        if not isinstance(horizon := self.objective.horizon, Integral) or horizon < 1:
            expected = "expected 1 step or more, a whole number, such as round(8 / timestep_s)"
            faults.append(f"objective: horizon {horizon}, {expected}")
        if not 0 < self.timestep_s < 2:
            expected = "expected above 0 and below 2 s, since datasets have a whole number of steps per second"
            faults.append(f"timestep_s: {expected}: got {self.timestep_s}")
        ball = (self.quantities or {}).get(_BALL)
        if ball is not None and (not ball or ball[0] < 2 or [*ball] != [ball[0], ball[0] + 1]):
            faults.append(
                f"quantities: {_BALL}: expected two indices in a row, of x and y, after the robot's, got {ball}"
            )
        if not NAME.fullmatch(self.name):
            faults.append("name: expected letters, digits, '.', '_' and '-', since datasets are named after it")
        if faults:
            raise BadInputError(f"task '{self.name}': {'; '.join(faults)}")
        abstract: Column = self.abstract_state or made.abstract_state  # type: ignore[attr-defined]
        usual = {
            "instruction": self.name,
            "action": Column(ACTION, size=len(commands), names=tuple(commands)),
            "goal": Column(GOAL, size=size) if (size := self.objective.goal_size) else None,
            "abstraction": getattr(made, "abstraction", None),
            "abstract_state": replace(abstract, name=ABSTRACT_STATE),
            "quantities": {name: (index,) for index, name in enumerate(names_with_units(abstract))},
            "simulator_id": _named(made),
        }
        derived = {name: value for name, value in usual.items() if not getattr(self, name)}
        called = {"state": STATE, "action": ACTION, "goal": GOAL, "abstract_state": ABSTRACT_STATE}
        other = {name: column for name, column in named.items() if column and column.name != called[name]}
        known = {name: replace(column, name=called[name]) for name, column in other.items()}
        for name, value in {**known, "commands": commands, **derived, "derived": derived}.items():
            object.__setattr__(self, name, value)

    @property
    def state_columns(self) -> tuple[Column, ...]:
        """The columns of states, of goals if there are any, of actions and of next states."""
        later = f"{self.state.meaning}, one control step later" if self.state.meaning else ""
        goal = () if self.goal is None else (self.goal,)
        return (self.state, *goal, self.action, replace(self.state, name=NEXT_STATE, meaning=later))

    @property
    def limits(self) -> Commands:
        """The bounds of the commands, and the way from them to ±1 and back."""
        return cast(Commands, self.commands)

    @property
    def has_target(self) -> bool:
        """Whether there is a target to collect in and to test in."""
        return self.robot is not None or self.make_target is not None

    @property
    def plane(self) -> Maze | None:
        """The maze; None where there is none."""
        maze = getattr(self.objective, "maze", None)  # a user's may be anything
        return maze if isinstance(maze, Maze) else None

    @property
    def maze(self) -> Maze:
        """The maze; BadInputError where there is none."""
        if self.plane is None:
            advice = "leave out what needs a maze (augment, follower, clearance_m, start 'anywhere')"
            raise BadInputError(f"expected a task in a maze, got '{self.name}', which has none: {advice}")
        return self.plane

    @property
    def ball_index(self) -> int | None:
        """Index in abstract states, after the robot's x and y, of the ball's x; None where there is no ball."""
        ball = self.quantities.get(_BALL, ())
        return ball[0] if len(ball) == 2 and ball[0] >= 2 else None

    @property
    def ball_rolls(self) -> bool:
        """Whether abstract states end with the ball's position and velocity."""
        moves = self.quantities.get("ball_velocity_m_s")
        return moves is not None and self.ball_index == moves[0] - 2 == self.abstract_state.size - 4

    @property
    def fps(self) -> int:
        """Control steps per second, rounded, for LeRobot takes whole numbers."""
        return round(1.0 / self.timestep_s)

    def target(self, num_envs: int, **options: Any) -> TargetEnv:
        """Build `num_envs` target environments, driven by actions of ±1; `options` are their own."""
        if self.make_target is not None:
            given = ", ".join(f"{name}={value!r}" for name, value in options.items())
            with explained(f"make_target(objective, {num_envs}, {given})"):
                return self.make_target(self.objective, num_envs, **options)
        if self.robot is None:
            advice = "give it a `robot`, or leave out what needs one (collect, rows trained in the target)"
            raise BadInputError(f"task '{self.name}' has no target: {advice}")
        return RobotEnv(self, num_envs, **options)

    def own_simulator(self, num_envs: int, device: str = "cpu") -> AbstractSimulator:
        """Build `num_envs` abstract simulators, driven by commands in their units."""
        takes_device = "device" in inspect.signature(self.make_simulator).parameters
        return self.make_simulator(num_envs, **({"device": device} if takes_device else {}))

    def simulator(self, num_envs: int, device: str = "cpu") -> TaskSimulator:
        """Build `num_envs` abstract simulators, driven by actions of ±1."""
        simulator = self.own_simulator(num_envs, device)
        is_whole = all(hasattr(simulator, name) for name in ("blocked", "settle", "vary"))
        is_there = simulator.state.device.type == torch.device(device).type
        if self.limits.are_normal and is_whole and is_there:
            return cast(TaskSimulator, simulator)
        return DrivenSimulator(simulator, self.limits, device)

    def varied_simulator(self, num_envs: int, variation: Variation, device: str = "cpu") -> VariedSimulator:
        """Build `num_envs` abstract simulators whose parameters vary; those without a range are plain."""
        ranges = type(self.varied.wide)(**variation.model_dump())
        return self.varied.kind(self.simulator(num_envs, device), ranges)


def _named(made: object) -> str:
    return getattr(made, "__name__", type(made).__name__)
