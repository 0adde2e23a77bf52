import hashlib
import json
import sys
from pathlib import Path

import pytest

from astra_data.core.errors import BadInputError
from astra_data.robots.registry import task_named
from astra_data.worlds.task import Task
from astra_data.worlds.user_code import explained, file_of, found_near, is_user_code, user_object

CART = Path(__file__).parents[1] / "small_cart.py"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("cart.py:TASK", True),
        ("robots/cart.py:TASK", True),
        ("package.module:TASK", True),
        ("antmaze-umaze", False),
        ("cart.py", False),
        (":TASK", False),
        ("cart.py:", False),
        ("s3://bucket", False),
    ],
)
def test_code_is_named_by_its_place_and_an_object(name: str, expected: bool) -> None:
    assert is_user_code(name) == expected


def test_a_file_is_run_once_and_its_objects_are_found() -> None:
    task = task_named(f"{CART}:TASK")
    assert isinstance(task, Task) and task.name == "rail-cart"
    assert task_named(f"{CART}:TASK") is task
    assert task_named(f"{CART}:LOGS_ALONE") is user_object(f"{CART}:LOGS_ALONE")


def test_a_file_imports_those_beside_it_but_hides_no_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.path", [*sys.path])
    (tmp_path / "wheels_of_mine.py").write_text("COUNT = 4\n")
    (tmp_path / "json.py").write_text("dumps = None\n")
    (tmp_path / "robot.py").write_text("import json\nfrom wheels_of_mine import COUNT\nDUMPS = json.dumps\n")
    assert user_object(f"{tmp_path / 'robot.py'}:COUNT") == 4
    assert user_object(f"{tmp_path / 'robot.py'}:DUMPS") is json.dumps


def test_a_module_of_an_installed_package_is_found() -> None:
    assert user_object("astra_data.worlds.task:Task") is Task
    with pytest.raises(BadInputError, match=r"importing no.such fails with ModuleNotFoundError"):
        user_object("no.such:TASK")
    with pytest.raises(BadInputError, match=r"astra_data.worlds.task:Task is a type, expected a Task"):
        task_named("astra_data.worlds.task:Task")


def test_a_file_that_fails_is_run_again(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("1 / 0")
    for _ in range(2):
        with pytest.raises(BadInputError, match=r"importing .*mine.py fails with ZeroDivisionError"):
            user_object(f"{file}:TASK")
    file.write_text("TASK = 3")
    assert user_object(f"{file}:TASK") == 3


def test_files_of_one_name_are_two(tmp_path: Path) -> None:
    for folder, value in (("a", 1), ("b", 2)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.py").write_text(f"VALUE = {value}")
    assert [user_object(f"{tmp_path}/{folder}/mine.py:VALUE") for folder in "ab"] == [1, 2]


def test_each_file_imports_those_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where another file of that name was imported."""
    for folder, value in (("a", 1), ("b", 2)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.py").write_text("from own_dynamics import TOLD\n")
        (tmp_path / folder / "own_dynamics.py").write_text("import own_facts\nTOLD = own_facts.VALUE")
        (tmp_path / folder / "own_facts.py").write_text(f"VALUE = {value}")
    assert [user_object(f"{tmp_path}/{folder}/mine.py:TOLD") for folder in "ab"] == [1, 2]
    (tmp_path / "a" / "again.py").write_text("import own_facts\nTOLD = own_facts.VALUE")
    first = [f"{tmp_path}/b", *sys.path]  # as the folder of a script is
    monkeypatch.setattr(sys, "path", [*first])
    assert user_object(f"{tmp_path}/a/again.py:TOLD") == 1
    (tmp_path / "b" / "again.py").write_text("import own_facts\nTOLD = own_facts.VALUE")
    assert user_object(f"{tmp_path}/b/again.py:TOLD") == 2
    assert sys.path == first
    assert sys.modules["own_facts"].VALUE == 1  # what was imported first stays so for all else


def test_a_file_that_failed_hides_no_neighbors_of_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    for folder, text in (("a", "VALUE = 1"), ("b", "1 / 0"), ("c", "from own_pose import HERE as VALUE")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.py").write_text(text)
    for folder in "ac":
        (tmp_path / folder / "own_pose.py").write_text(f"HERE = {folder!r}")
    assert user_object(f"{tmp_path}/a/mine.py:VALUE") == 1
    with pytest.raises(BadInputError, match="ZeroDivisionError"):
        user_object(f"{tmp_path}/b/mine.py:VALUE")
    assert user_object(f"{tmp_path}/c/mine.py:VALUE") == "c"


def test_what_is_not_there_is_answered_with_what_is(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    imports = (
        "from __future__ import annotations\nimport sys\nfrom pathlib import Path\nfrom typing import Any\n"
    )
    file.write_text(f"{imports}TASK = 3\n_HIDDEN = 4\ndef reach(): pass\n")
    with pytest.raises(BadInputError, match=r"mine.py has no 'TAKS'; it has TASK, reach$"):
        user_object(f"{file}:TAKS")
    with pytest.raises(BadInputError, match=r"none.py does not exist: expected a Python file"):
        user_object(f"{tmp_path}/none.py:TASK")
    with pytest.raises(
        BadInputError, match=f"none.py does not exist in {Path.cwd()}: expected a Python file"
    ):
        user_object("none.py:TASK")


def test_a_file_is_looked_up_above_a_folder_and_then_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, project = tmp_path / "here", tmp_path / "project"
    run = project / "runs/cart"
    for folder in (here, run):
        folder.mkdir(parents=True)
    monkeypatch.chdir(here)
    assert found_near("cart.py:TASK", run) == "cart.py:TASK"
    (here / "cart.py").touch()
    assert found_near("cart.py:TASK", run) == "cart.py:TASK"
    (project / "cart.py").touch()
    assert found_near("cart.py:TASK", run) == f"{project}/cart.py:TASK"
    (project / "runs/cart.py").touch()
    assert found_near("cart.py:TASK", run) == f"{project}/runs/cart.py:TASK"
    monkeypatch.chdir(project / "runs")
    assert found_near("cart.py:TASK", Path("cart")) == "cart.py:TASK"
    assert found_near(f"{here}/cart.py:TASK", run) == f"{here}/cart.py:TASK"
    (run / "cart.py").touch()
    assert found_near("cart.py:TASK", run) == f"{run}/cart.py:TASK"
    (run / "package.module").touch()
    for no_file in ("antmaze-umaze", "package.module:TASK"):
        assert found_near(no_file, run) == no_file


def test_a_file_is_known_by_its_digest() -> None:
    assert file_of(f"{CART}:TASK") == {"file_sha256": hashlib.sha256(CART.read_bytes()).hexdigest()}
    assert file_of("antmaze-umaze") == file_of("package.module:TASK") == {}


def test_an_error_names_the_line_of_the_file_that_it_comes_from(tmp_path: Path) -> None:
    file = tmp_path / "wheel.py"
    file.write_text("import numpy as np\n\n\ndef roll():\n    return np.zeros(3).reshape(2, 2)\n")
    roll = user_object(f"{file}:roll")
    told = r"^rolling fails with ValueError: .* \(wheel.py, line 5\)$"
    with pytest.raises(BadInputError, match=told), explained("rolling"):
        roll()


def test_a_message_of_several_lines_is_told_in_one() -> None:
    told = r"^rolling fails with RuntimeError: motor stalled: twice \(test_own_code.py, line \d+\)$"
    with pytest.raises(BadInputError, match=told), explained("rolling"):
        raise RuntimeError("motor\r\nstalled:\n\n  twice\n")


def test_a_file_that_exits_is_an_error_and_not_an_end(tmp_path: Path) -> None:
    file = tmp_path / "script.py"
    file.write_text("import sys\nsys.exit(0)\n")
    with pytest.raises(BadInputError, match=r"importing .*script.py ends the program \(script.py, line 2\)"):
        user_object(f"{file}:TASK")


def test_a_place_is_named_once_and_only_where_it_is_the_users(tmp_path: Path) -> None:
    file = tmp_path / "wrong.py"
    file.write_text("clas Cart:\n")
    with pytest.raises(BadInputError, match=r"SyntaxError: .* \(wrong.py, line 1\)$"):
        user_object(f"{file}:TASK")
    with pytest.raises(BadInputError, match=r"No module named 'no'$"):
        user_object("no.such:TASK")


def test_a_file_of_another_kind_is_no_module(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"cart.csv: expected a Python file"):
        user_object(f"{tmp_path / 'cart.csv'}:TASK")


def test_a_file_s_neighbors_come_before_those_of_others_whatever_was_appended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "gears_of_mine.py").write_text(f"FOLDER = '{folder}'\n")
        (tmp_path / folder / "robot.py").write_text("from gears_of_mine import FOLDER\n")
    (tmp_path / "one/robot.py").write_text("FOLDER = 'one'\n")  # does not import its neighbor
    assert user_object(f"{tmp_path}/one/robot.py:FOLDER") == "one"
    sys.path.append(f"{tmp_path}/policy")
    assert user_object(f"{tmp_path}/two/robot.py:FOLDER") == "two"
