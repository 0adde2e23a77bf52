import hashlib
import sys
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path

import mujoco
import my_simulator
import numpy as np
import pytest
import torch
from small_cart import GIVEN

from astra_data.core.errors import BadInputError
from astra_data.dataset.columns import Column
from astra_data.robots.registry import SIMULATOR_GROUP, TASKS, built, checked_abstraction, pairing_named
from astra_data.worlds import user_code
from astra_data.worlds.plane.mazes import U_MAZE
from astra_data.worlds.simulators import MujocoModel
from astra_data.worlds.task import Task
from astra_data.worlds.user_code import explained

MINE = Path(my_simulator.__file__)
STATES = np.arange(87, dtype=np.float32).reshape(3, 29)


def test_a_task_brings_its_own_simulator() -> None:
    pairing, task = pairing_named("antmaze-umaze"), TASKS["antmaze-umaze"]
    assert (pairing.id, pairing.origin, pairing.maze) == ("point_mass", {"task": "antmaze-umaze"}, U_MAZE)
    assert pairing.abstract_state == task.abstract_state
    assert built(pairing, 5).state.shape == (5, 4)
    np.testing.assert_array_equal(checked_abstraction(pairing, STATES), STATES[:, [0, 1, 15, 16]])
    assert pairing_named("humanoid-kinematics").maze is None
    # Commands of ±1 need no bounds.
    assert pairing.commands is None
    assert dict(pairing_named("small_cart:TASK").commands or {}) == {"v": (-1.0, 4.0)}


def test_a_class_of_a_file_is_known_by_its_name_and_the_files_digest() -> None:
    pairing = pairing_named(f"{MINE}:Glider")
    assert (pairing.id, pairing.maze) == ("Glider", None)
    assert pairing.origin == {"file_sha256": hashlib.sha256(MINE.read_bytes()).hexdigest()}
    batch = built(pairing, 2)
    batch.reset_to(torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    batch.reset_to(torch.tensor([[5.0, 6.0]]), torch.tensor([1]))
    assert batch.step(torch.tensor([[2.0, 0.0], [0.0, -2.0]])).tolist() == pytest.approx(
        np.array([[1.1, 2.0], [5.0, 5.9]])
    )
    np.testing.assert_array_equal(checked_abstraction(pairing, STATES), STATES[:, :2])


def test_abstract_states_are_stored_as_float32_under_their_own_name(tmp_path: Path) -> None:
    file = tmp_path / "sim.py"
    file.write_text(
        "import my_simulator\n"
        "from astra_data.dataset.columns import Column\n"
        "class Wide(my_simulator.Glider):\n"
        "    abstract_state = Column('place', size=2)\n"
        "    @staticmethod\n"
        "    def abstraction(state):\n"
        "        return state[:, 1::-1].astype('float64')\n"
    )
    pairing = pairing_named(f"{file}:Wide")
    assert pairing.abstract_state.name == "abstract.state"
    abstract = checked_abstraction(pairing, STATES)
    assert abstract.dtype == np.float32 and abstract.flags.c_contiguous
    np.testing.assert_array_equal(abstract, STATES[:, [1, 0]])
    assert any(name.startswith("astra_data_user_sim_") for name in sys.modules)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("1 / 0", r"importing .*sim.py fails with ZeroDivisionError: division by zero \(sim.py, line 1\)$"),
        ("class Other: pass", r"sim.py has no 'Mine'; it has Other$"),
        (
            "class Mine: pass",
            r"has no abstract_state, abstraction, parameters, reset_to, step: expected what a",
        ),
        (
            "class Mine:\n    abstract_state = abstraction = parameters = reset_to = step = 1",
            r"sim.py:Mine.abstract_state is a int, expected a Column",
        ),
    ],
)
def test_a_file_without_a_simulator_is_refused(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "sim.py").write_text(text)
    with pytest.raises(BadInputError, match=told):
        pairing_named(f"{tmp_path}/sim.py:Mine")


def test_a_file_without_a_class_is_no_task() -> None:
    with pytest.raises(BadInputError, match=r"mine.py: expected the class after a colon, as in mine.py:My"):
        pairing_named("mine.py")


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ("Narrow", r"Narrow\(4\).state has shape \(4, 1\), expected \(4, 2\)"),
        ("Bare", r"Bare.parameters: expected numbers or texts for maze"),
        ("Clumsy", r"Clumsy\(4\) fails with TypeError"),
    ],
)
def test_a_batch_of_another_kind_is_refused(kind: str, told: str) -> None:
    with pytest.raises(BadInputError, match=told):
        built(pairing_named(f"{MINE}:{kind}"), 4)


def test_a_map_to_another_shape_is_refused() -> None:
    with pytest.raises(BadInputError, match=r"Wide makes \(3, 3\) of states \(3, 29\), expected \(3, 2\)"):
        checked_abstraction(pairing_named(f"{MINE}:Wide"), STATES)
    with pytest.raises(BadInputError, match=r"Greedy, given states \(3, 29\), fails with IndexError"):
        checked_abstraction(pairing_named(f"{MINE}:Greedy"), STATES)


def test_errors_of_the_users_code_keep_their_cause() -> None:
    with (
        pytest.raises(BadInputError, match=r"^the wheel fails with ValueError: flat \(test_simu") as caught,
        explained("the wheel"),
    ):
        raise ValueError("flat")
    assert isinstance(caught.value.__cause__, ValueError)


def test_installed_packages_offer_simulators_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    offered = [
        EntryPoint(name, "my_simulator:Glider", SIMULATOR_GROUP) for name in ("glider", "antmaze-umaze")
    ]
    monkeypatch.setattr(user_code, "entry_points", lambda group: {SIMULATOR_GROUP: offered}.get(group, []))
    pairing = pairing_named("glider")
    assert (pairing.id, pairing.origin) == ("glider", {"package": "my_simulator:Glider"})
    assert pairing.simulator(2).step(torch.ones(2, 2)).tolist() == pytest.approx(np.full((2, 2), 0.05))
    assert pairing_named("antmaze-umaze").id == "point_mass"
    with pytest.raises(BadInputError, match=r"unknown task 'glidr': did you mean 'glider'"):
        pairing_named("glidr")


def test_a_mujoco_model_is_the_simulator_of_a_task() -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.01"/><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>'
        '<geom size="0.1" mass="2"/></body></worldbody><actuator><motor joint="rail"/></actuator></mujoco>'
    )
    task = Task(
        **{**GIVEN, "make_simulator": partial(MujocoModel, model, substeps=10)},
        abstraction=lambda state: state,
        abstract_state=Column("abstract.state", size=2, names=("x", "v")),
    )
    simulator = task.simulator(2)
    simulator.reset_to(torch.tensor([[0.0, 1.0], [5.0, 0.0]]))
    landed = simulator.step(torch.tensor([[1.0], [-1.0]]))  # 4 N and -1 N on 2 kg, for 0.1 s
    by_hand = []
    for x, v, force in ((0.0, 1.0, 4.0), (5.0, 0.0, -1.0)):
        for _ in range(10):
            v += 0.01 * force / 2.0
            x += 0.01 * v
        by_hand.append([x, v])
    assert landed.numpy() == pytest.approx(np.array(by_hand), rel=1e-5)
