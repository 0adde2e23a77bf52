import hashlib
from importlib.metadata import EntryPoint
from pathlib import Path

import my_simulator
import numpy as np
import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import ACTION, GOAL, STATE
from astra_data.robots import registry
from astra_data.worlds import user_code
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.task import Task
from astra_data.worlds.variation import VariedSimulator


@pytest.mark.parametrize("task", registry.TASKS.values(), ids=registry.TASKS)
def test_worlds_and_columns_fit_together(task: Task) -> None:
    assert registry.TASKS[task.name] is task and task.fps * task.timestep_s == pytest.approx(1.0, abs=0.05)
    sizes = {column.name: column.size for column in task.state_columns}
    env = task.target(2, seed=0, num_threads=1)
    env.reset()
    assert env.state.shape == (2, sizes[STATE])
    assert sizes[ACTION] == env.action_size == task.objective.action_size
    assert sizes.get(GOAL, 0) == env.goal.shape[1] == task.objective.goal_size
    entries = [entry for group in task.quantities.values() for entry in group]
    assert set(entries) <= set(range(task.abstract_state.size)) and len(entries) == len(set(entries))
    assert task.simulator(1).parameters["timestep_s"] == task.timestep_s


@pytest.mark.parametrize("task", registry.TASKS.values(), ids=registry.TASKS)
def test_simulators_vary(task: Task) -> None:
    state, action = task.simulator(3).state, torch.full((3, task.objective.action_size), 0.5)
    landed = []
    for variation in (task.varied.randomized, task.varied.wide, type(task.varied.wide)()):
        torch.manual_seed(0)
        simulator = task.varied_simulator(3, variation)
        assert isinstance(simulator, VariedSimulator)
        simulator.reset_to(state)
        landed.append(simulator.step(action).clone())
    assert len(landed[0].unique(dim=0)) == len(landed[1].unique(dim=0)) == 3
    torch.testing.assert_close(landed[2], task.simulator(3).step(action))


def test_a_task_of_the_package_comes_before_an_installed_one_of_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("rail-cart", "antmaze-umaze")
    points = [EntryPoint(name, "small_cart:TASK", registry.TASK_GROUP) for name in names]
    monkeypatch.setattr(user_code, "entry_points", lambda group: points)
    assert registry.known_names() == (*registry.TASKS, "rail-cart")
    assert registry.task_named("antmaze-umaze") is registry.TASKS["antmaze-umaze"]
    assert registry.place_of("rail-cart") == registry.place_of("small_cart:TASK") == "small_cart:TASK"
    assert registry.place_of("antmaze-umaze") == "antmaze-umaze" and registry.place_of("unknown") == "unknown"


def test_an_unknown_task_answers_with_the_known_ones() -> None:
    with pytest.raises(BadInputError, match=r"unknown task 'antmaze-umase'.*antmaze-umaze"):
        registry.task_named("antmaze-umase")


MINE = Path(my_simulator.__file__)
STATES = np.arange(87, dtype=np.float32).reshape(3, 29)


def test_a_task_brings_its_own_simulator() -> None:
    pairing, task = registry.pairing_named("antmaze-umaze"), registry.TASKS["antmaze-umaze"]
    assert (pairing.id, pairing.origin, pairing.maze) == ("point_mass", {"task": "antmaze-umaze"}, U_MAZE)
    assert pairing.abstract_state == task.abstract_state and registry.built(pairing, 5).state.shape == (5, 4)
    np.testing.assert_array_equal(registry.checked_abstraction(pairing, STATES), STATES[:, [0, 1, 15, 16]])
    assert registry.pairing_named("humanoid-kinematics").maze is None
    assert pairing.commands is None  # commands of ±1 need no bounds
    assert dict(registry.pairing_named("small_cart:TASK").commands or {}) == {"v": (-1.0, 4.0)}


def test_a_class_of_a_file_is_known_by_its_name_and_the_files_digest() -> None:
    pairing = registry.pairing_named(f"{MINE}:Glider")
    assert (pairing.id, pairing.maze) == ("Glider", None)
    assert pairing.origin == {"file_sha256": hashlib.sha256(MINE.read_bytes()).hexdigest()}
    batch = registry.built(pairing, 2)
    batch.reset_to(torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    batch.reset_to(torch.tensor([[5.0, 6.0]]), torch.tensor([1]))
    assert batch.step(torch.tensor([[2.0, 0.0], [0.0, -2.0]])).tolist() == pytest.approx(
        np.array([[1.1, 2.0], [5.0, 5.9]])
    )
    np.testing.assert_array_equal(registry.checked_abstraction(pairing, STATES), STATES[:, :2])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("class Mine: pass", r"has no abstract_state, abstraction, parameters, reset_to, step: expected what a"),
        (
            "class Mine:\n    abstract_state = abstraction = parameters = reset_to = step = 1",
            r"sim.py:Mine.abstract_state is a int, expected a Column",
        ),
    ],
)
def test_a_file_without_a_simulator_is_refused(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "sim.py").write_text(text)
    with pytest.raises(BadInputError, match=told):
        registry.pairing_named(f"{tmp_path}/sim.py:Mine")


def test_installed_packages_offer_simulators_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    offered = [
        EntryPoint(name, "my_simulator:Glider", registry.SIMULATOR_GROUP) for name in ("glider", "antmaze-umaze")
    ]
    monkeypatch.setattr(user_code, "entry_points", lambda group: {registry.SIMULATOR_GROUP: offered}.get(group, []))
    pairing = registry.pairing_named("glider")
    assert (pairing.id, pairing.origin) == ("glider", {"package": "my_simulator:Glider"})
    assert pairing.simulator(2).step(torch.ones(2, 2)).tolist() == pytest.approx(np.full((2, 2), 0.05))
    assert registry.pairing_named("antmaze-umaze").id == "point_mass"
    with pytest.raises(BadInputError, match=r"unknown task 'glidr': did you mean 'glider'"):
        registry.pairing_named("glidr")
