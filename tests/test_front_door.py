"""`import astra_data`: which names it has, that they load late, and what works without the heavy packages."""

import ast
import doctest
import inspect
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from fake_dataset import write_fake

import astra_data
from astra_data.core.errors import EXTRAS, BadInputError
from astra_data.pipeline.stages.collect import CollectConfig, collect
from astra_data.robots.registry import TASKS

PUBLIC = [
    *("Column", "Dataset", "DatasetWriter", "Episode", "Frames", "METHODS", "Objective", "Simulator"),
    *("StagedWriter", "TASKS", "Task", "align", "augment", "collect", "evaluate", "ground", "label"),
    *("load_policy", "merge", "pair", "pull", "push", "run", "subset", "train"),
]
RECIPE = """
task = "antmaze-umaze"
methods = ["direct_transfer", "nas"]
seeds = [0]

[collect]
episodes = 4
max_steps = 20
"""
WITHOUT = """
import sys
class Missing:
    def find_spec(name, *_):
        if name in {names!r}: raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Missing)
"""


def python(code: str, *arguments: str) -> str:
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_these_names_are_public_and_no_others() -> None:
    assert astra_data.__all__ == sorted(PUBLIC) and dir(astra_data) == sorted(PUBLIC)
    tree = ast.parse(Path(astra_data.__file__).read_text())
    typed = [alias.asname for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert sorted(name for name in typed if name) == sorted(PUBLIC)
    assert (Path(astra_data.__file__).parent / "py.typed").exists()


def examples(name: str) -> list[doctest.Example]:
    return doctest.DocTestParser().get_examples(inspect.getdoc(getattr(astra_data, name)) or "")


def test_every_name_is_what_it_says_and_has_an_example() -> None:
    for name in PUBLIC:
        if name.isupper():
            assert len(getattr(astra_data, name)) > 5
        else:
            assert getattr(astra_data, name).__name__ == name
            assert examples(name), f"{name} shows no example"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what the examples begin with: walks, their pairs, and a small recipe."""
    made = tmp_path_factory.mktemp("examples")
    config = CollectConfig(episodes=12, max_steps=20, start="task")
    collect("antmaze-umaze", config, name="walks", out=made / "walks")
    astra_data.pair("antmaze-umaze", dataset=made / "walks", out=made / "pairs")
    (made / "small.toml").write_text(RECIPE)
    return made


@pytest.mark.usefixtures("quick_fits")
@pytest.mark.parametrize("name", [name for name in PUBLIC if not name.isupper() and name != "load_policy"])
def test_examples_run(name: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in folder.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    if name == "train":  # episodes as long as usual take seconds
        task = TASKS["antmaze-umaze"]
        monkeypatch.setitem(TASKS, task.name, replace(task, objective=replace(task.objective, horizon=25)))
    test = doctest.DocTest(examples(name), {}, name, None, 0, None)
    failures: list[str] = []
    doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=failures.append)
    assert not failures, "".join(failures)


def test_an_unknown_name_is_answered_with_the_known_ones() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'Datset'; it has Column, Dataset, "):
        astra_data.Datset  # noqa: B018


def test_importing_the_package_loads_nothing() -> None:
    loaded = python("import sys, astra_data; print(*sys.modules)").split()
    assert not {"numpy", "pydantic", "pyarrow", "torch"} & set(loaded)


def test_datasets_need_none_of_the_extras(tmp_path: Path) -> None:
    write_fake(tmp_path / "whole")
    code = WITHOUT.format(names=tuple(EXTRAS)) + (
        "from pathlib import Path\nfrom astra_data import Dataset, subset, merge, StagedWriter, pull\n"
        "data = Dataset.open(Path(sys.argv[1]))\n"
        "print(len(Dataset.open(subset(data, episodes=1, out=Path(sys.argv[2])))))\n"
    )
    assert python(code, str(tmp_path / "whole"), str(tmp_path / "one")) == "1\n"


def test_a_card_with_its_figure_needs_no_more_than_its_own_extra(tmp_path: Path) -> None:
    write_fake(tmp_path / "whole")
    code = WITHOUT.format(names=("torch", "safetensors", "mujoco", "gymnasium")) + (
        "from pathlib import Path\nfrom astra_data import Dataset\n"
        "from astra_data.io.hub.card import Notes, write_card\n"
        "import astra_data.io.hub.sharing\n"
        "write_card(Dataset.open(Path(sys.argv[1])), Path(sys.argv[2]), Notes())\n"
    )
    python(code, str(tmp_path / "whole"), str(tmp_path / "card.md"))
    assert (tmp_path / "card-coverage.png").is_file()


def test_what_needs_an_extra_says_which() -> None:
    code = WITHOUT.format(names=("torch",)) + (
        "import astra_data\nfrom astra_data.core.errors import BadInputError\n"
        "try: astra_data.TASKS['antmaze-umaze'].simulator(1)\nexcept BadInputError as error: print(error)\n"
    )
    assert "uv sync --extra sim" in python(code) and issubclass(BadInputError, Exception)
