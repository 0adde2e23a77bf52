import hashlib
import sys
from pathlib import Path

import pytest

from astra_data.core.errors import BadInputError
from astra_data.worlds.user_code import code_digest


def test_code_has_one_digest_in_every_version_of_python(tmp_path: Path) -> None:
    (tmp_path / "cart.py").write_text("TASK = 1\n")
    assigned = "Assign(targets=[Name(id='TASK', ctx=Store())], value=Constant(value=1))"
    parsed = f"Module(body=[{assigned}], type_ignores=[])"
    told = hashlib.sha256(f"cart.py\n{parsed}\n".encode()).hexdigest()
    assert code_digest(f"{tmp_path}/cart.py:TASK") == told


def test_code_is_known_by_what_it_does_and_imports_beside_it(tmp_path: Path) -> None:
    (tmp_path / "cart.py").write_text("from wheel import R\nimport json\nTASK = R\n")
    (tmp_path / "wheel.py").write_text("import cart\nR = 1\n")
    (tmp_path / "json.py").write_text("")
    first = code_digest(f"{tmp_path}/cart.py:TASK")
    (tmp_path / "cart.py").write_text("# A cart.\nfrom wheel import R\nimport json\n\nTASK = (R)\n")
    assert code_digest(f"{tmp_path}/cart.py:TASK") == first
    (tmp_path / "wheel.py").write_text("import cart\nR = 2\n")
    assert code_digest(f"{tmp_path}/cart.py:TASK") not in (first, None)
    assert code_digest("antmaze-umaze") is code_digest("some.module:TASK") is None
    (tmp_path / "wheel.py").write_text("R = 1\nR = = 2\n")
    with pytest.raises(BadInputError, match=r"wheel\.py, line 2: expected Python, got invalid syntax"):
        code_digest(f"{tmp_path}/cart.py:TASK")


def test_the_digest_covers_a_package_beside_the_file(tmp_path: Path) -> None:
    (tmp_path / "parts/joints").mkdir(parents=True)
    (tmp_path / "cart.py").write_text("from parts.joints import knee\nTASK = knee.LIMIT\n")
    (tmp_path / "parts/__init__.py").write_text("import wheel\n")
    (tmp_path / "wheel.py").write_text("R = 1\n")
    (tmp_path / "other.py").write_text("R = 1\n")
    (tmp_path / "parts/joints/knee.py").write_text("LIMIT = 1\n")
    digests = [code_digest(f"{tmp_path}/cart.py:TASK")]
    for path, text in (("other.py", "R = 2"), ("parts/joints/knee.py", "LIMIT = 2"), ("wheel.py", "R = 2")):
        (tmp_path / path).write_text(text)
        digests.append(code_digest(f"{tmp_path}/cart.py:TASK"))
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3
    (tmp_path / "parts/template.py").write_text("class {{ name }}:\n")
    (tmp_path / "cart.py").write_text("import numpy\nfrom parts.joints import knee\nTASK = knee.LIMIT\n")
    assert (with_template := code_digest(f"{tmp_path}/cart.py:TASK")) not in (*digests, None)
    (tmp_path / "numpy").mkdir()
    (tmp_path / "numpy/__init__.py").write_text("not the one that is installed\n")
    assert code_digest(f"{tmp_path}/cart.py:TASK") == with_template


def test_the_digest_covers_data_that_the_files_name(tmp_path: Path) -> None:
    """A model in MuJoCo's XML, say; what is beside it and not named does not count."""
    (tmp_path / "parts").mkdir()
    names = ["", "/", "\0.xml", "cart.py", "run.log", "../beside.xml", f"{'轮' * 100}.xml"]
    (tmp_path / "cart.py").write_text(f'XML = "parts/cart.xml"\nNO = {names}\n')
    (tmp_path / "run.log").write_text("1")
    (tmp_path / "parts/cart.xml").write_text("<mujoco/>")
    (tmp_path / "other.xml").write_text("<mujoco/>")
    first = code_digest(f"{tmp_path}/cart.py:TASK")
    (tmp_path / "other.xml").write_text("<mujoco></mujoco>")
    (tmp_path / "run.log").write_text("2")
    assert code_digest(f"{tmp_path}/cart.py:TASK") == first
    (tmp_path / "parts/cart.xml").write_text("<mujoco></mujoco>")
    assert code_digest(f"{tmp_path}/cart.py:TASK") not in (first, None)


@pytest.mark.parametrize(
    ("code", "file"),
    [
        ("WEIGHTS = 'w.pt'", "w.pt"),
        ("WEIGHTS = open('w.pkl')", "w.pkl"),
        ("WEIGHTS = open('w.safetensors')", "w.safetensors"),
        ("SETTINGS = open('c.yml')", "c.yml"),
        ("DATA = 'd.h5'", "d.h5"),
        ("TABLE = 'table'", "table"),
        ("DATA = 'data/w.npz'", "data/w.npz"),
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
    first = code_digest(place)
    (named.parent / "another.npz").write_text("2")
    assert code_digest(place) == first
    named.write_text("2")
    assert code_digest(place) not in (first, None)


def test_folders_that_lead_back_are_looked_into_once(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data/back").symlink_to(tmp_path)
    (tmp_path / "data/w.npz").write_text("1")
    (tmp_path / "cart.py").write_text("NAMES = ['data', 'back', 'w.npz', '.', './data']\n")
    first = code_digest(f"{tmp_path}/cart.py:TASK")
    (tmp_path / "data/w.npz").write_text("2")
    assert code_digest(f"{tmp_path}/cart.py:TASK") not in (first, None)


def test_data_outside_of_its_folder_does_not_count(tmp_path: Path) -> None:
    (tmp_path / "cart").mkdir()
    (tmp_path / "cart/cart.py").write_text('XML = "../beside.xml"\n')
    without = code_digest(f"{tmp_path}/cart/cart.py:TASK")
    (tmp_path / "beside.xml").write_text("<mujoco/>")
    assert code_digest(f"{tmp_path}/cart/cart.py:TASK") == without


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
    first = code_digest(place)
    (library / "others.py").write_text("LIMIT = 2\n")
    (library / "levers_of_mine/__init__.py").write_text("import others  # Another.\nLIMIT = 1\n")
    assert code_digest(place) == first
    (library / "levers_of_mine/parts/knee.py").write_text("import others\nLIMIT = 2\n")
    assert code_digest(place) not in (first, None)
    assert "levers_of_mine" not in sys.modules


def test_a_module_in_no_package_is_known_by_its_file(library: Path) -> None:
    first = code_digest("others:TASK")
    (library / "levers_of_mine/__init__.py").write_text("")
    assert code_digest("others:TASK") == first
    (library / "others.py").write_text("import levers_of_mine\nLIMIT = 2\n")
    assert code_digest("others:TASK") not in (first, None)


def test_a_package_in_a_folder_of_packages_is_known_by_its_own_files(library: Path) -> None:
    (library / "company/arms").mkdir(parents=True)
    (library / "company/arms/__init__.py").write_text("LIMIT = 1\n")
    first = code_digest("company.arms:TASK")
    (library / "company/legs.py").write_text("LIMIT = 1\n")
    assert code_digest("company.arms:TASK") == first
    (library / "company/arms/__init__.py").write_text("LIMIT = 2\n")
    assert code_digest("company.arms:TASK") not in (first, None)
    assert code_digest("company.legs:TASK") is not None


def test_this_package_is_known_by_its_commit_alone() -> None:
    assert code_digest("astra_data.robots.registry:TASKS") is code_digest("not.here:TASK") is None
