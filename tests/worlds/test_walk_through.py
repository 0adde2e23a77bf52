"""Each wrong piece of a task is named by one line, and what is right by none."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from on_meta import places
from small_cart import TASK, Cart, Rail, Reach
from torch import Tensor

from astra_data.robots.registry import TASKS, task_named
from astra_data.worlds.task import Task
from astra_data.worlds.walk_through import check_task

EXAMPLE_FILES = Path(__file__).parents[2] / "recipes" / "examples"


@pytest.mark.parametrize("task", [TASK, *TASKS.values()], ids=lambda task: task.name)
def test_nothing_is_wrong_with_the_tasks_of_the_package(task: Task) -> None:
    assert check_task(task) == []


EXAMPLES = [f"{EXAMPLE_FILES}/{file}.py:TASK" for file in ("cart/cart", "fetch/push", "fetch/reach")]


@pytest.mark.parametrize("name", [*TASKS, *EXAMPLES])
def test_objectives_compute_where_states_are(name: str) -> None:
    assert places(task_named(name)) == {"meta"}


def every(timestep_s: float) -> Task:
    return replace(simulator(parameters={"timestep_s": timestep_s}), timestep_s=timestep_s)


@pytest.mark.parametrize(
    ("timestep_s", "told"),
    [
        (0.1, ""),
        (0.0333, ""),
        (0.015, ""),  # 66.67, by less than 0.5 %
        (0.15, "timestep_s 0.15: a dataset has a whole number of steps per second, 7, and so its steps are 4.8%"),
        (0.11, "timestep_s 0.11: a dataset has a whole number of steps per second, 9, and so its steps are 1.0%"),
    ],
)
def test_a_rate_that_is_no_whole_number_is_told(timestep_s: float, told: str, caplog: pytest.LogCaptureFixture) -> None:
    assert check_task(every(timestep_s)) == []
    assert (f"task rail-cart: {told}" in caplog.text) if told else not caplog.records


@pytest.mark.parametrize(("timestep_s", "way"), [(0.4, "25.0% too long"), (0.65, "23.1% too short")])
def test_a_rate_that_is_far_from_a_whole_number_is_refused(timestep_s: float, way: str) -> None:
    (fault,) = check_task(every(timestep_s))
    assert fault.startswith(f"timestep_s {timestep_s}: a dataset has a whole number") and way in fault


def simulator(**methods: object) -> Task:
    return replace(TASK, make_simulator=type("Own", (Rail,), methods))


def objective(**methods: object) -> Task:
    return replace(TASK, objective=type("Own", (Reach,), methods)(horizon=40))


def robot(**methods: object) -> Task:
    return replace(TASK, robot=type("Own", (Cart,), methods))


def abstraction(made: Callable[[Any], Any]) -> Task:
    return replace(TASK, abstraction=made)


class Own:
    """Ways to be wrong, as methods of a simulator."""

    def single(self, num_envs: int) -> None:
        self.state = torch.zeros(1)

    def deaf(self, state: Tensor, rows: Tensor | None = None) -> None:
        self.state = self.state.clone()

    def whole(self, state: Tensor, rows: Tensor | None = None) -> None:
        self.state = state if rows is None else self.state

    def doubled(self, state: Tensor, rows: Tensor | None = None) -> None:
        self.state = state.double()

    def lost(self, command: Tensor) -> Tensor:
        return Rail.step(self, command) * torch.nan  # type: ignore[arg-type]

    def stuck(self, command: Tensor) -> Tensor:
        raise ValueError("flat battery")


WRONG: list[tuple[Task, str]] = [
    (robot(step=lambda self, command: 1 / 0), "step of the robot fails with ZeroDivisionError"),
    (
        robot(step=lambda self, command: ([0.0, 0.0], "no")),
        "step of the robot: expected True or False for whether it failed, got 'no'",
    ),
    (
        simulator(state=property(lambda self: torch.zeros(3, 1, dtype=torch.double), lambda self, _: None)),
        "make_simulator(3).state, 3 states at once: expected torch.float32, got torch.float64",
    ),
    (simulator(__init__=Own.single), "make_simulator(3).state, 3 states at once: expected shape (3, 1), got (1,)"),
    (simulator(reset_to=Own.deaf), "make_simulator: after reset_to(state), state: expected 3 in row 2, entry 0, got 0"),
    (
        simulator(reset_to=Own.whole),
        "make_simulator: after reset_to(state, rows), state: expected 1 in row 2, entry 0, got 3",
    ),
    (
        simulator(parameters={"timestep_s": 0.014}),
        "make_simulator(3): expected steps of timestep_s, 0.1 s, got steps of 0.014 s",
    ),
    (simulator(step=Own.lost), "make_simulator: step(command) of shape (3, 1): expected finite numbers, got nan"),
    (simulator(step=Own.stuck), "make_simulator: step(command) fails with ValueError: flat battery"),
    (
        objective(reward=lambda self, before, after, goal, failed: after - before),
        "objective.reward(before, after, goal, failed): expected shape (3,), got (3, 1)",
    ),
    (
        objective(reward=lambda self, before, after, goal, failed: (after - before)[:, 0].double()),
        "objective.reward(before, after, goal, failed): expected torch.float32, got torch.float64",
    ),
    (
        replace(objective(observe=lambda self, state, goal: state.double()), robot=None),
        "objective.observe(state, goal): expected torch.float32, got torch.float64",
    ),
    (
        objective(missed=lambda self, state, goal: state[:, 0] < 5.0),
        "objective.missed: expected False where episodes start, got True for [[1.0], [2.0], [3.0]]",
    ),
    (
        objective(reached=lambda self, state, goal: state[:, 0].clamp(0, 1)),
        "objective.reached(state, goal): expected torch.bool, got torch.float32",
    ),
    (
        replace(objective(observe=lambda self, state, goal: state[:, 0]), robot=None),
        "objective.observe(state, goal): expected shape (3, any), got (3,)",
    ),
    (
        objective(places=lambda self, state: state.expand(-1, 3)),
        "objective.places(state): expected x and y of K bodies, shape (3, 2 K), got (3, 3)",
    ),
    (
        objective(draw_starts=lambda self, rng, count: torch.zeros(count, 1)),
        "objective.draw_starts(rng, 3): expected a NumPy array of numbers, got a Tensor",
    ),
    (
        objective(draw_starts=lambda self, rng, count: np.random.default_rng().uniform(size=(count, 1))),
        "objective.draw_starts(rng, 3): expected the same from an rng of the same seed, got others",
    ),
    (
        replace(objective(draw_goals=lambda self, rng, count: np.array([["x"]] * count)), robot=None),
        "objective.draw_goals(rng, 3): expected a NumPy array of numbers, got one of <U1",
    ),
    (simulator(parameters={"timestep_s": None}), "make_simulator(3).parameters fails with TypeError: float() argument"),
    (
        simulator(reset_to=Own.doubled),
        "make_simulator: after reset_to(state), state: expected torch.float32, got torch.float64",
    ),
    (
        simulator(step=lambda self, command: command.long()),
        "make_simulator: step(command) of shape (3, 1): expected to",
    ),
    (
        replace(TASK, quantities={"x": cast(Any, (0.0,))}),
        "quantities fails with TypeError: 'float' object cannot be interpreted",
    ),
    (
        replace(abstraction(lambda state: np.array(state[..., :1], object)), robot=None),
        "abstraction (φ) of states (3, 2) fails with TypeError: can't convert np.ndarray of type numpy.object_",
    ),
    (
        replace(objective(draw_goals=lambda self, rng, count: np.zeros((count, 2))), robot=None),
        "objective.draw_goals(rng, 3): expected shape (3, 1), got (3, 2): write `goal_size = 2` beside the "
        "objective's action_size",
    ),
    (
        replace(objective(draw_goals=lambda self, rng, count: np.zeros((count, 0))), robot=None),
        "objective.draw_goals(rng, 3): expected shape (3, 1), got (3, 0): write draw_goals",
    ),
    (
        replace(TASK, make_target=cast(Any, lambda count: None)),
        "make_target(objective, 1, seed=0) fails with TypeError: ",
    ),
    (
        replace(abstraction(lambda state: state[..., :1] * np.nan), robot=None),
        "abstraction (φ) of states (3, 2): expected finite numbers, got nan",
    ),
    (
        replace(abstraction(lambda state: state), robot=None),
        "abstraction (φ) of states (3, 2): expected a ndarray of shape (3, 1), got a ndarray of (3, 2)",
    ),
    (
        replace(TASK, quantities={"x": (0,), "y": (0, 1), "z": (-2,)}),
        "quantities: y, z: expected indices below 1, of states",
    ),
    (replace(TASK, beyond=lambda state: state[..., 0]), "beyond of states (3, 2): expected shape (3, any), got (3,)"),
]


@pytest.fixture(autouse=True)
def starts_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Reach, "draw_starts", lambda self, rng, count: 1.0 + np.arange(float(count))[:, None])


@pytest.mark.parametrize(("task", "line"), WRONG, ids=[line for _, line in WRONG])
def test_the_wrong_piece_is_named_in_one_line(task: Task, line: str) -> None:
    faults = check_task(task)
    assert len(faults) == 1 and faults[0].startswith(line) and "\n" not in faults[0]
