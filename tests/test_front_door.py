"""`import astra_data`: which names it has, that they load late, and what works without the heavy packages."""

import ast
import doctest
import inspect
import subprocess
import sys
from pathlib import Path

import pytest
from fake_dataset import write_fake

import astra_data
from astra_data.core.errors import BadInputError
from astra_data.core.optional import EXTRAS

PUBLIC = [
    *("Column", "Dataset", "DatasetWriter", "Episode", "Frames", "METHODS", "Objective", "Simulator"),
    *("StagedWriter", "TASKS", "Task", "align", "augment", "evaluate", "ground", "load_policy", "merge"),
    *("pair", "pull", "push", "run", "subset", "train"),
]
WITHOUT = "import sys\nfor name in {names!r}: sys.modules[name] = None\n"


def python(code: str, *arguments: str) -> str:
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_these_names_are_public_and_no_others() -> None:
    assert astra_data.__all__ == sorted(PUBLIC)
    assert dir(astra_data) == sorted(PUBLIC)
    tree = ast.parse(Path(astra_data.__file__).read_text())
    typed = [
        alias.asname for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names
    ]
    assert sorted(name for name in typed if name) == sorted(PUBLIC)
    assert (Path(astra_data.__file__).parent / "py.typed").exists()


@pytest.mark.parametrize("name", PUBLIC)
def test_every_name_is_what_it_says_and_has_an_example(name: str) -> None:
    found = getattr(astra_data, name)
    if name.isupper():
        assert len(found) > 10
        return
    assert found.__name__ == name
    assert doctest.DocTestParser().get_examples(inspect.getdoc(found) or ""), f"{name} shows no example"


def test_an_unknown_name_is_answered_with_the_known_ones() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'Datset'; it has Column, Dataset, "):
        astra_data.Datset  # type: ignore[attr-defined] # noqa: B018


def test_importing_the_package_loads_nothing() -> None:
    loaded = python("import sys, astra_data; print(*sys.modules)").split()
    assert not {"numpy", "pydantic", "pyarrow", "torch"} & set(loaded)


def test_datasets_need_none_of_the_extras(tmp_path: Path) -> None:
    write_fake(tmp_path / "whole")
    code = WITHOUT.format(names=(*EXTRAS, "lerobot", "h5py")) + (
        "from pathlib import Path\nfrom astra_data import Dataset, subset, merge, StagedWriter, pull\n"
        "data = Dataset.open(Path(sys.argv[1]))\n"
        "print(len(Dataset.open(subset(data, episodes=1, out=Path(sys.argv[2])))))\n"
    )
    assert python(code, str(tmp_path / "whole"), str(tmp_path / "one")) == "1\n"


def test_what_needs_an_extra_says_which() -> None:
    code = WITHOUT.format(names=("torch",)) + (
        "import astra_data\nfrom astra_data.core.errors import BadInputError\n"
        "try: astra_data.pair\nexcept BadInputError as error: print(error)\n"
    )
    assert 'pip install "astra-data[sim]"' in python(code)
    assert issubclass(BadInputError, Exception)
