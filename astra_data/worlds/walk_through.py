"""Walk through a task, and name what is wrong with it, before anything long begins."""

import logging
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from astra_data.core.errors import BadInputError
from astra_data.core.seeding import generator
from astra_data.worlds.protocols import AbstractSimulator
from astra_data.worlds.robot import RobotEnv
from astra_data.worlds.task import Task
from astra_data.worlds.user_code import expect, expect_same, expect_tensor, explained, judged, paid, stepped

_COUNT = 3
_EVEN = 0.005
"""Relative error of a rate that is taken for a whole number, as by `new`."""
_MOST_UNEVEN = 0.1
"""Largest one that is not refused, as by imports."""
_RESETS = 5
"""Of a robot, to see where it starts."""
_DRAWN = 200
"""Starts, to see in which range the objective draws them."""
_log = logging.getLogger(__name__)


def check_task(task: Task, device: str = "cpu") -> list[str]:
    """Return one line for each piece of a task that is not as it should be; none if all is well.

    Three states are drawn, set, stepped and judged. A robot is reset a few times and is given no command;
    target environments that the task builds itself are left out. A warning is logged where robots start far
    from where the objective draws starts.

    Args:
        task: what to walk through.
        device: torch device on which policies would be trained for it.
    """
    faults: list[str] = []

    def tried[T](check: Callable[..., T], *given: object) -> T | None:
        try:
            return check(task, *given)
        except BadInputError as error:
            faults.append(str(error))
            return None

    tried(_rate)
    starts, goals, simulator = tried(_starts), tried(_goals), tried(_simulator, device)
    tried(_abstraction)
    tried(_quantities)
    tried(_beyond)
    tried(_robot)
    if starts is None or simulator is None:
        return faults
    starts = starts.to(simulator.state.device)
    if tried(_reset, simulator, starts):
        landed = tried(_step, simulator, starts)
        apart = None if faults else tried(_starts_apart, simulator, starts)
        if apart:
            _log.warning(f"task {task.name}: {apart}")
        if landed is not None and goals is not None:
            before, after, goals = (values.to(device) for values in (starts, landed, goals))
            tried(_observation, after, goals)
            tried(_places, after)
            if tried(_ends, after, goals):
                tried(_reward, before, after, goals)
    return faults


def _of_numpy(what: str, found: object, shape: tuple[int, ...]) -> Tensor:
    if not isinstance(found, np.ndarray):
        raise BadInputError(f"{what}: expected a NumPy array, got a {type(found).__name__}")
    return expect(what, torch.from_numpy(np.ascontiguousarray(found)), shape).float()


def _rate(task: Task) -> None:
    """Tell that the steps per second are no whole number; refuse it as an import does."""
    error = 1.0 / (task.timestep_s * task.fps) - 1.0
    if abs(error) < _EVEN:
        return
    line = (
        f"timestep_s {task.timestep_s:g}: a dataset has a whole number of steps per second, {task.fps}, and "
        f"so its steps are {abs(error):.1%} too {'long' if error > 0 else 'short'}: take 1 / {task.fps} s, "
        "or another period that divides a second"
    )
    if abs(error) > _MOST_UNEVEN:
        raise BadInputError(line)
    _log.warning(f"task {task.name}: {line}")


def _starts(task: Task) -> Tensor:
    what = f"objective.draw_starts(rng, {_COUNT})"
    with explained(what):
        found = task.objective.draw_starts(generator(0, "starts"), _COUNT)
    return _of_numpy(what, found, (_COUNT, task.abstract_state.size))


def _goals(task: Task) -> Tensor:
    what = f"objective.draw_goals(rng, {_COUNT})"
    with explained(what):
        found = task.objective.draw_goals(generator(0, "goals"), _COUNT)
        size = found.shape[1] if np.ndim(found) == 2 else task.objective.goal_size
    if size != task.objective.goal_size:
        raise BadInputError(
            f"{what}: expected shape ({_COUNT}, {task.objective.goal_size}), got {np.shape(found)}: write "
            f"`goal_size = {size}` beside the objective's action_size"
        )
    return _of_numpy(what, found, (_COUNT, task.objective.goal_size))


def _abstraction(task: Task) -> None:
    state = generator(0, "states").normal(size=(_COUNT, task.state.size)).astype(np.float32)
    wanted, what = (_COUNT, task.abstract_state.size), f"abstraction (φ) of states {state.shape}"
    for given in (state, torch.from_numpy(state)):
        with explained(what):
            found = task.abstraction(given)
        shape = tuple(getattr(found, "shape", ()))
        if not isinstance(found, type(given)) or shape != wanted:
            raise BadInputError(
                f"{what}: expected a {type(given).__name__} of shape {wanted}, got a {type(found).__name__} "
                f"of {shape}; abstract_state has {wanted[1]} values"
            )
        expect(what, torch.as_tensor(found), wanted)


def _quantities(task: Task) -> None:
    size = task.abstract_state.size
    with explained("quantities"):
        wrong = [name for name, of in task.quantities.items() if not {*of} <= {*range(-size, size)}]
    if wrong:
        raise BadInputError(f"quantities: {', '.join(wrong)}: expected indices below {size}, of states")


def _beyond(task: Task) -> None:
    state = torch.from_numpy(generator(0, "states").normal(size=(_COUNT, task.state.size))).float()
    with explained(what := f"beyond of states {tuple(state.shape)}"):
        found = expect_tensor(what, task.beyond(state))
    if found.dim() != 2 or len(found) != _COUNT:
        raise BadInputError(f"{what}: expected shape ({_COUNT}, any), got {tuple(found.shape)}")


def _robot(task: Task) -> None:
    if task.robot is None:
        return
    with explained("robot: to build and to reset it"):
        env = task.target(1, seed=0)
        env.reset()
        abstract = task.abstraction(env.state)
        if isinstance(env, RobotEnv):
            env.check_commands()
            env.check_seed()
    expect("abstraction (φ) of the robot's state", abstract, (1, task.abstract_state.size))


def _simulator(task: Task, device: str) -> AbstractSimulator:
    what = f"make_simulator({_COUNT})"
    with explained(what):
        simulator = task.own_simulator(_COUNT, device)
        state = simulator.state
    expect(f"{what}.state, {_COUNT} states at once", state, (_COUNT, task.abstract_state.size))
    return simulator


def _reset(task: Task, simulator: AbstractSimulator, starts: Tensor) -> bool:
    with explained("make_simulator: reset_to(state)"):
        simulator.reset_to(starts.clone())
        shown = simulator.state
    expect_same("make_simulator: after reset_to(state), state", shown, starts)
    with explained("make_simulator: reset_to(state, rows)"):
        simulator.reset_to(starts[[0, 1]], torch.tensor([2, 0], device=starts.device))
        shown = simulator.state
    expect_same("make_simulator: after reset_to(state, rows), state", shown, starts[[1, 1, 0]])
    return True


def _step(task: Task, simulator: AbstractSimulator, starts: Tensor) -> Tensor:
    what, command = "make_simulator: step(command)", _commands(task).to(starts.device)
    simulator.reset_to(starts.clone())
    landed = stepped(simulator, command.clone(), what)
    return expect(f"{what} of shape {tuple(command.shape)}", landed, tuple(starts.shape)).clone()


def _starts_apart(task: Task, simulator: AbstractSimulator, starts: Tensor) -> str:
    """Tell where robots start far from where the objective draws starts; nothing where they do not.

    Far is further outside of the range of the drawn ones, in each of a few resets, than that is wide and the
    simulator moves in a second, from `starts`.
    """
    if task.robot is None:
        return ""
    env, resets = task.target(1, seed=0), []
    for _ in range(_RESETS):
        env.reset()
        resets.append(torch.as_tensor(task.abstraction(env.state)))
    robot = torch.cat(resets)
    with explained("objective.draw_starts(rng, n)"):
        drawn = torch.as_tensor(task.objective.draw_starts(generator(0, "starts"), _DRAWN)).float()
    low, high = drawn.amin(dim=0), drawn.amax(dim=0)
    command = _commands(task).to(starts.device)
    with explained("make_simulator: step(command), for a second"):
        simulator.reset_to(starts.clone())
        for _ in range(task.fps):
            simulator.step(command.clone())
        moved = (simulator.state - starts).abs().amax(dim=0).cpu()
    outside = torch.maximum(low - robot, robot - high).amin(dim=0)
    far = (outside > high - low + moved).nonzero().flatten().tolist()
    if not far:
        return ""
    entry = far[0]
    return (
        f"the robot starts at {task.abstract_state.labels[entry]} = {robot[:, entry].min():.4g} to "
        f"{robot[:, entry].max():.4g}, far from where objective.draw_starts puts the simulator, "
        f"{low[entry]:.4g} to {high[entry]:.4g}: policies start training from the latter: draw starts like "
        "the robot's, or check φ and its units"
    )


def _commands(task: Task) -> Tensor:
    """Return random commands (3, A), in their units."""
    drawn = generator(0, "actions").uniform(-1.0, 1.0, (_COUNT, len(task.limits)))
    return task.limits.in_units(torch.from_numpy(drawn).float())


def _observation(task: Task, state: Tensor, goal: Tensor) -> None:
    what = "objective.observe(state, goal)"
    with explained(what):
        found = task.objective.observe(state, goal)
    expect(what, found, (_COUNT, -1), device=state.device)


def _places(task: Task, state: Tensor) -> None:
    what = "objective.places(state)"
    with explained(what):
        found = task.objective.places(state)
    _, size = expect(what, found, (_COUNT, -1), device=state.device).shape
    if size % 2:
        raise BadInputError(
            f"{what}: expected x and y of K bodies, shape ({_COUNT}, 2 K), got ({_COUNT}, {size})"
        )


def _ends(task: Task, state: Tensor, goal: Tensor) -> bool:
    for name in ("reached", "missed"):
        judged(task.objective, name, state, goal)
    return True


def _reward(task: Task, before: Tensor, after: Tensor, goal: Tensor) -> None:
    for failed in (False, True):
        paid(task.objective, before, after, goal, torch.full((_COUNT,), failed, device=after.device))
