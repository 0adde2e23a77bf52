import hashlib
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from astra_data.core.errors import BadInputError
from astra_data.robots.registry import task_named
from astra_data.worlds import user_code
from astra_data.worlds.task import Task

CART = Path(__file__).parents[1] / "small_cart.py"


def test_code_is_named_by_its_place_and_an_object() -> None:
    assert all(map(user_code.is_user_code, ("cart.py:TASK", "package.module:TASK")))
    assert not any(map(user_code.is_user_code, ("antmaze-umaze", ":TASK", "cart.py:", "s3://bucket")))


def test_a_file_is_run_once_and_its_objects_are_found() -> None:
    task = task_named(f"{CART}:TASK")
    assert isinstance(task, Task) and task.name == "rail-cart" and task_named(f"{CART}:TASK") is task
    assert task_named(f"{CART}:LOGS_ALONE") is user_code.user_object(f"{CART}:LOGS_ALONE")


def test_a_file_imports_those_beside_it_but_hides_no_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.path", [*sys.path])
    (tmp_path / "wheels_of_mine.py").write_text("COUNT = 4\n")
    (tmp_path / "json.py").write_text("dumps = None\n")
    (tmp_path / "robot.py").write_text("import json\nfrom wheels_of_mine import COUNT\nDUMPS = json.dumps\n")
    assert user_code.user_object(f"{tmp_path / 'robot.py'}:COUNT") == 4
    assert user_code.user_object(f"{tmp_path / 'robot.py'}:DUMPS") is json.dumps


def test_a_module_of_an_installed_package_is_found() -> None:
    assert user_code.user_object("astra_data.worlds.task:Task") is Task
    with pytest.raises(BadInputError, match=r"importing no.such fails with ModuleNotFoundError"):
        user_code.user_object("no.such:TASK")
    with pytest.raises(BadInputError, match=r"astra_data.worlds.task:Task is a type, expected a Task"):
        task_named("astra_data.worlds.task:Task")


def test_each_file_imports_those_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where another file of that name was imported."""
    for folder, value in (("a", 1), ("b", 2)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.py").write_text("from own_dynamics import TOLD\n")
        (tmp_path / folder / "own_dynamics.py").write_text("import own_facts\nTOLD = own_facts.VALUE")
        (tmp_path / folder / "own_facts.py").write_text(f"VALUE = {value}")
    assert [user_code.user_object(f"{tmp_path}/{folder}/mine.py:TOLD") for folder in "ab"] == [1, 2]
    (tmp_path / "a" / "again.py").write_text("import own_facts\nTOLD = own_facts.VALUE")
    first = [f"{tmp_path}/b", *sys.path]  # as the folder of a script is
    monkeypatch.setattr(sys, "path", [*first])
    assert user_code.user_object(f"{tmp_path}/a/again.py:TOLD") == 1
    (tmp_path / "b" / "again.py").write_text("import own_facts\nTOLD = own_facts.VALUE")
    assert user_code.user_object(f"{tmp_path}/b/again.py:TOLD") == 2 and sys.path == first
    assert sys.modules["own_facts"].VALUE == 1  # what was imported first stays so for all else


def test_what_is_not_there_is_answered_with_what_is(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("import sys\nfrom pathlib import Path\nTASK = 3\n_HIDDEN = 4\ndef reach(): pass\n")
    with pytest.raises(BadInputError, match=r"mine.py has no 'TAKS'; it has TASK, reach$"):
        user_code.user_object(f"{file}:TAKS")
    with pytest.raises(BadInputError, match=r"^cart.py: expected a .* and a name in it, such as cart.py:METHOD"):
        user_code.user_object("cart.py")
    with pytest.raises(BadInputError, match=r"none.py does not exist: expected a Python file"):
        user_code.user_object(f"{tmp_path}/none.py:TASK")
    with pytest.raises(BadInputError, match=f"none.py does not exist in {Path.cwd()}: expected a Python file"):
        user_code.user_object("none.py:TASK")


def test_a_file_is_looked_up_above_a_folder_and_then_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here, project = tmp_path / "here", tmp_path / "project"
    run = project / "runs/cart"
    for folder in (here, run):
        folder.mkdir(parents=True)
    monkeypatch.chdir(here)
    assert user_code.found_near("cart.py:TASK", run) == "cart.py:TASK"
    (here / "cart.py").touch()
    assert user_code.found_near("cart.py:TASK", run) == "cart.py:TASK"
    (project / "cart.py").touch()
    assert user_code.found_near("cart.py:TASK", run) == f"{project}/cart.py:TASK"
    (project / "runs/cart.py").touch()
    assert user_code.found_near("cart.py:TASK", run) == f"{project}/runs/cart.py:TASK"
    monkeypatch.chdir(project / "runs")
    assert user_code.found_near("cart.py:TASK", Path("cart")) == "cart.py:TASK"
    assert user_code.found_near(f"{here}/cart.py:TASK", run) == f"{here}/cart.py:TASK"
    (run / "cart.py").touch()
    assert user_code.found_near("cart.py:TASK", run) == f"{run}/cart.py:TASK"
    (run / "package.module").touch()
    for no_file in ("antmaze-umaze", "package.module:TASK"):
        assert user_code.found_near(no_file, run) == no_file


def test_a_file_is_known_by_its_digest() -> None:
    assert user_code.file_of(f"{CART}:TASK") == {"file_sha256": hashlib.sha256(CART.read_bytes()).hexdigest()}
    assert user_code.file_of("antmaze-umaze") == user_code.file_of("package.module:TASK") == {}


def test_an_error_names_the_line_of_the_file_that_it_comes_from(tmp_path: Path) -> None:
    file = tmp_path / "wheel.py"
    file.write_text("import numpy as np\n\n\ndef roll():\n    return np.zeros(3).reshape(2, 2)\n")
    roll = user_code.user_object(f"{file}:roll")
    told = r"^rolling fails with ValueError: .* \(wheel.py, line 5\)$"
    with pytest.raises(BadInputError, match=told), user_code.explained("rolling"):
        roll()


def test_a_file_that_exits_is_an_error_and_not_an_end(tmp_path: Path) -> None:
    file = tmp_path / "script.py"
    file.write_text("import sys\nsys.exit(0)\n")
    with pytest.raises(BadInputError, match=r"importing .*script.py ends the program \(script.py, line 2\)"):
        user_code.user_object(f"{file}:TASK")


def test_code_has_one_digest_in_every_version_of_python(tmp_path: Path) -> None:
    (tmp_path / "cart.py").write_text("TASK = 1\n")
    assigned = "Assign(targets=[Name(id='TASK', ctx=Store())], value=Constant(value=1))"
    parsed = f"Module(body=[{assigned}], type_ignores=[])"
    told = hashlib.sha256(f"cart.py\n{parsed}\n".encode()).hexdigest()
    assert user_code.code_digest(f"{tmp_path}/cart.py:TASK") == told


def test_code_is_known_by_what_it_does_and_imports_beside_it(tmp_path: Path) -> None:
    (tmp_path / "cart.py").write_text("from wheel import R\nimport json\nTASK = R\n")
    (tmp_path / "wheel.py").write_text("import cart\nR = 1\n")
    (tmp_path / "json.py").write_text("")
    first = user_code.code_digest(f"{tmp_path}/cart.py:TASK")
    (tmp_path / "cart.py").write_text("# A cart.\nfrom wheel import R\nimport json\n\nTASK = (R)\n")
    assert user_code.code_digest(f"{tmp_path}/cart.py:TASK") == first
    (tmp_path / "wheel.py").write_text("import cart\nR = 2\n")
    assert user_code.code_digest(f"{tmp_path}/cart.py:TASK") not in (first, None)
    assert user_code.code_digest("antmaze-umaze") is user_code.code_digest("some.module:TASK") is None
    (tmp_path / "wheel.py").write_text("R = 1\nR = = 2\n")
    with pytest.raises(BadInputError, match=r"wheel\.py, line 2: expected Python, got invalid syntax"):
        user_code.code_digest(f"{tmp_path}/cart.py:TASK")


def test_the_digest_covers_a_package_beside_the_file(tmp_path: Path) -> None:
    (tmp_path / "parts/joints").mkdir(parents=True)
    (tmp_path / "cart.py").write_text("from parts.joints import knee\nTASK = knee.LIMIT\n")
    (tmp_path / "parts/__init__.py").write_text("import wheel\n")
    (tmp_path / "wheel.py").write_text("R = 1\n")
    (tmp_path / "other.py").write_text("R = 1\n")
    (tmp_path / "parts/joints/knee.py").write_text("LIMIT = 1\n")
    digests = [user_code.code_digest(f"{tmp_path}/cart.py:TASK")]
    for path, text in (("other.py", "R = 2"), ("parts/joints/knee.py", "LIMIT = 2"), ("wheel.py", "R = 2")):
        (tmp_path / path).write_text(text)
        digests.append(user_code.code_digest(f"{tmp_path}/cart.py:TASK"))
    assert digests[0] == digests[1] and len(set(digests)) == 3
    (tmp_path / "parts/template.py").write_text("class {{ name }}:\n")
    (tmp_path / "cart.py").write_text("import numpy\nfrom parts.joints import knee\nTASK = knee.LIMIT\n")
    assert (user_code.code_digest(f"{tmp_path}/cart.py:TASK")) not in (*digests, None)


@pytest.mark.parametrize(
    ("code", "file"),
    [
        ("WEIGHTS = 'w.pt'", "w.pt"),
        ("DATA = Path(__file__).parent / 'data' / 'w.npz'", "data/w.npz"),
        ("DATA = Path(HERE, 'data/deep').joinpath('er', 'w.npz')", "data/deep/er/w.npz"),
    ],
)
def test_data_of_any_kind_count_by_their_names_or_the_parts_of_their_paths(
    tmp_path: Path, code: str, file: str
) -> None:
    place, named = f"{tmp_path}/cart.py:TASK", tmp_path / file
    named.parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "cart.py").write_text(f"{code}\n")
    (named.parent / "another.npz").write_text("1")
    named.write_text("1")
    first = user_code.code_digest(place)
    (named.parent / "another.npz").write_text("2")
    assert user_code.code_digest(place) == first
    named.write_text("2")
    assert user_code.code_digest(place) not in (first, None)


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of installed packages."""
    folder = tmp_path / "site-packages"
    (folder / "levers_of_mine/parts").mkdir(parents=True)
    for name in ("levers_of_mine/__init__.py", "levers_of_mine/parts/knee.py", "others.py"):
        (folder / name).write_text("import others\nLIMIT = 1\n")
    monkeypatch.syspath_prepend(folder)
    return folder


@pytest.mark.parametrize("place", ["levers_of_mine:TASK", "levers_of_mine.parts.knee:TASK"])
def test_installed_code_is_known_by_all_of_its_package(library: Path, place: str) -> None:
    first = user_code.code_digest(place)
    (library / "others.py").write_text("LIMIT = 2\n")
    (library / "levers_of_mine/__init__.py").write_text("import others  # Another.\nLIMIT = 1\n")
    assert user_code.code_digest(place) == first
    (library / "levers_of_mine/parts/knee.py").write_text("import others\nLIMIT = 2\n")
    assert user_code.code_digest(place) not in (first, None) and "levers_of_mine" not in sys.modules


class Linear:
    """What a user wrote, whose parts on disk are wrong in some way."""

    def __init__(self, returned: object) -> None:
        self.returned = returned

    def to_file(self) -> Any:
        return self.returned() if callable(self.returned) else self.returned


@pytest.mark.parametrize(
    ("returned", "told"),
    [
        (
            ({"w": np.ones(2), "b": torch.ones(1), "n": 3}, {}),
            r"'w' is a ndarray, expected a torch tensor, as torch.as_tensor\(value\) is; 'n' is a int, .*",
        ),
        (
            ({"w": torch.ones(1)}, {"sizes": [1], "mean": torch.ones(2), "at": [np.float32(1)]}),
            "'mean' is a Tensor, expected a JSON value, or it among the tensors; 'at' is a list, .*",
        ),
        ({"w": torch.ones(1)}, "expected a pair, a dict of tensors and one of JSON values, got a dict"),
        (({1: torch.ones(1)}, {2: 3}), "the name 1, expected a text; the name 2, expected a text"),
        (None, "expected a pair, .*, got a NoneType"),
        (({}, {}, {}), "expected a pair, .*, got a tuple"),
    ],
)
def test_anything_else_is_told(returned: object, told: str) -> None:
    with pytest.raises(BadInputError, match=f"^Linear.to_file: {told}$"):
        user_code.parts_of(Linear(returned))


OWN = """
import torch

class Own:
    @classmethod
    def from_file(cls, tensors, metadata, *device):
        return metadata["matrx"]
"""
TENSORS, METADATA = {"matrix": torch.ones(2), "factor": torch.ones(1)}, {"sizes": [2], "kind": "mine"}


def test_what_it_asks_for_and_the_file_has_not_is_told_with_what_it_has(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(OWN)
    given = "^Own.from_file, given the tensors matrix, factor and the values sizes, kind, fails with KeyError: 'matrx' "
    with pytest.raises(BadInputError, match=given + r"\(mine.py, line 7\)$"):
        user_code.restored(user_code.user_object(f"{tmp_path / 'mine.py'}:Own"), TENSORS, METADATA)


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ([[0.0, 0.0]], "step: expected a torch tensor, got a list"),
        (torch.zeros(3), r"step: expected shape \(any, 2\), got \(3,\)"),
        (torch.zeros(3, 4), r"step: expected shape \(any, 2\), got \(3, 4\)"),
        (torch.zeros(3, 2).double(), "step: expected torch.float32, got torch.float64"),
        (torch.tensor([[0.0, 1.0], [float("inf"), 2.0]]), "step: expected finite numbers, got inf"),
        (torch.tensor([[0.0, float("nan")]]), "step: expected finite numbers, got nan"),
    ],
)
def test_anything_else_is_refused_with_what_it_is(found: object, said: str) -> None:
    """One line says what was expected and what came."""
    with pytest.raises(BadInputError, match=f"^{said}"):
        user_code.expect("step", found, (-1, 2), torch.float32)


def test_answers_come_where_the_states_are() -> None:
    """Else they meet no other tensor of a training on a GPU; "meta" stands for one."""
    with pytest.raises(BadInputError, match=r"^pay: expected a tensor on meta, where its inputs are, got cpu$"):
        user_code.expect("pay", torch.zeros(3), (3,), device=torch.device("meta"))


def test_rewards_of_a_network_record_no_gradients() -> None:
    network, state = torch.nn.Linear(1, 1), torch.zeros(3, 1)
    objective: Any = SimpleNamespace(reward=lambda before, after, goal, failed: network(after)[:, 0])
    assert user_code.paid(objective, state, state, state, state[:, 0] > 0).numpy().shape == (3,)
