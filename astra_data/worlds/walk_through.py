"""Walk through a task, and name what is wrong with it, before anything long begins."""

import logging
from collections.abc import Callable
from operator import index

import numpy as np

from astra_data.core.errors import BadInputError
from astra_data.core.lazy import Tensor, torch
from astra_data.core.seeding import generator
from astra_data.worlds.protocols import AbstractSimulator
from astra_data.worlds.task import RobotEnv, Task
from astra_data.worlds.user_code import answered, expect, expect_tensor, explained, judged, paid, stepped

_COUNT = 3
_EVEN, _MOST_UNEVEN = 0.005, 0.1  # relative errors of a rate that `new` takes for whole, and that imports do not refuse
_MOST_APART = 0.01  # relative, of a simulator's step and the task's
_TOLERANCE = 1e-4  # between states, relative to their size: simulators compute in single precision
_log = logging.getLogger(__name__)


def check_task(task: Task, device: str = "cpu") -> list[str]:
    """Return one line for each faulty piece of a task; `device` is where policies are trained."""
    faults: list[str] = []

    def tried[T](check: Callable[..., T], *given: object) -> T | None:
        try:
            return check(task, *given)
        except BadInputError as error:
            faults.append(str(error))
            return None

    for check in (_rate, _abstraction, _quantities, _beyond):
        tried(check)
    starts = tried(_drawn, "starts", task.abstract_state.size)
    goals, simulator = tried(_drawn, "goals", task.objective.goal_size), tried(_simulator, device)
    if starts is None or simulator is None:
        return faults
    starts = starts.to(simulator.state.device)
    landed = tried(_moved, simulator, starts)
    if landed is not None and goals is not None:
        before, after, goals = (values.to(device) for values in (starts, landed, goals))
        for judge in (_observation, _places, _judgement):
            tried(judge, before, after, goals)
    if not faults:  # a robot's step judges, too
        tried(_robot)
    return faults


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


def _drawn(task: Task, kind: str, size: int) -> Tensor:
    what = f"objective.draw_{kind}(rng, {_COUNT})"
    draw = getattr(task.objective, f"draw_{kind}")
    found, again = (answered(what, draw, generator(0, kind), _COUNT) for _ in range(2))
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "biuf":
        got = f"one of {found.dtype}" if isinstance(found, np.ndarray) else f"a {type(found).__name__}"
        raise BadInputError(f"{what}: expected a NumPy array of numbers, got {got}")
    if kind == "goals" and found.ndim == 2 and (wide := found.shape[1]) != size:
        advice = f"`goal_size = {wide}` beside the objective's action_size" if wide else "draw_goals"
        raise BadInputError(f"{what}: expected shape ({_COUNT}, {size}), got {found.shape}: write {advice}")
    drawn = expect(what, torch.from_numpy(np.ascontiguousarray(found)), (_COUNT, size)).float()
    if not np.array_equal(found, again):
        raise BadInputError(f"{what}: expected the same from an rng of the same seed, got others: draw with rng alone")
    return drawn


def _states(task: Task) -> Tensor:
    return torch.from_numpy(generator(0, "states").normal(size=(_COUNT, task.state.size))).float()


def _abstraction(task: Task) -> None:
    state, wanted = _states(task), (_COUNT, task.abstract_state.size)
    what = f"abstraction (φ) of states {tuple(state.shape)}"
    for given in (state.numpy(), state):
        found = answered(what, task.abstraction, given)
        shape = tuple(getattr(found, "shape", ()))
        if not isinstance(found, type(given)) or shape != wanted:
            got = f"a {type(found).__name__} of {shape}; abstract_state has {wanted[1]} values"
            raise BadInputError(f"{what}: expected a {type(given).__name__} of shape {wanted}, got {got}")
        expect(what, answered(what, torch.as_tensor, found), wanted)


def _quantities(task: Task) -> None:
    size = task.abstract_state.size
    with explained("quantities"):
        wrong = [name for name, of in task.quantities.items() if not {*map(index, of)} <= {*range(-size, size)}]
    if wrong:
        raise BadInputError(f"quantities: {', '.join(wrong)}: expected indices below {size}, of states")


def _beyond(task: Task) -> None:
    state = _states(task)
    what = f"beyond of states {tuple(state.shape)}"
    found = expect_tensor(what, answered(what, task.beyond, state))
    expect(what, torch.zeros_like(found), (_COUNT, -1))  # may be unknown: any numbers do


def _robot(task: Task) -> None:
    if task.robot is None:
        return
    with explained("make_target: to reset and step it" if task.make_target else "robot: to build, reset and step it"):
        env = task.target(1, seed=0)
        env.reset()
        abstract = task.abstraction(env.state)
        if isinstance(env, RobotEnv):
            env.check_commands()
        env.step(torch.zeros(1, len(task.limits)))
    expect("abstraction (φ) of the robot's state", abstract, (1, task.abstract_state.size))


def _simulator(task: Task, device: str) -> AbstractSimulator:
    what = f"make_simulator({_COUNT})"
    with explained(what):
        simulator = task.own_simulator(_COUNT, device)
        state = simulator.state
    with explained(f"{what}.parameters"):
        taken = float(simulator.parameters.get("timestep_s", task.timestep_s))
    if not abs(taken / task.timestep_s - 1) <= _MOST_APART:
        raise BadInputError(f"{what}: expected steps of timestep_s, {task.timestep_s:g} s, got steps of {taken:g} s")
    expect(f"{what}.state, {_COUNT} states at once", state, (_COUNT, task.abstract_state.size), torch.float32)
    return simulator


def _moved(task: Task, simulator: AbstractSimulator, starts: Tensor) -> Tensor:
    """Reset all and some rows, and step; return where that leads (3, X)."""
    rows = torch.tensor([2, 0], device=starts.device)
    for call, given, expected in (
        ("state", (starts.clone(),), starts),
        ("state, rows", (starts[[0, 1]], rows), starts[[1, 1, 0]]),
        ("state", (starts.clone(),), starts),
    ):
        with explained(f"make_simulator: reset_to({call})"):
            simulator.reset_to(*given)
            shown: object = simulator.state
        what = f"make_simulator: after reset_to({call}), state"
        shown = expect(what, shown, tuple(expected.shape), torch.float32)
        if not torch.allclose(shown, expected, rtol=_TOLERANCE, atol=_TOLERANCE):
            apart = (shown - expected).abs()
            row, entry = (apart == apart.max()).nonzero()[0].tolist()
            wanted, got = (float(of[row, entry]) for of in (expected, shown))
            raise BadInputError(f"{what}: expected {wanted:g} in row {row}, entry {entry}, got {got:g}")
    drawn = generator(0, "actions").uniform(-1.0, 1.0, (_COUNT, len(task.limits)))
    command = task.limits.in_units(torch.from_numpy(drawn).float()).to(starts.device)
    what = "make_simulator: step(command)"
    landed = stepped(simulator, command, what)
    return expect(f"{what} of shape {tuple(command.shape)}", landed, tuple(starts.shape), torch.float32).clone()


def _observation(task: Task, _: Tensor, state: Tensor, goal: Tensor) -> None:
    what = "objective.observe(state, goal)"
    seen = answered(what, task.objective.observe, state, goal)
    expect(what, seen, (_COUNT, -1), torch.float32, state.device)


def _places(task: Task, _: Tensor, state: Tensor, goal: Tensor) -> None:
    what = "objective.places(state)"
    size = expect(what, answered(what, task.objective.places, state), (_COUNT, -1), device=state.device).shape[1]
    if size % 2:
        raise BadInputError(f"{what}: expected x and y of K bodies, shape ({_COUNT}, 2 K), got ({_COUNT}, {size})")


def _judgement(task: Task, before: Tensor, after: Tensor, goal: Tensor) -> None:
    for name in ("reached", "missed"):
        judged(task.objective, name, after, goal)
    if judged(task.objective, "missed", before, goal).all():
        raise BadInputError(f"objective.missed: expected False where episodes start, got True for {before.tolist()}")
    for failed in (False, True):
        paid(task.objective, before, after, goal, torch.full((_COUNT,), failed, device=after.device))
