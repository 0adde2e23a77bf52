"""The map in `astra_data`'s docstring, enforced; and: rooms have no inner doors, files stay short."""

import ast
import re
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import astra_data

HOUSE = Path(__file__).parents[1] / "astra_data"

NO_NEIGHBOURS = {"envs", "exporters", "importers", "sims", "methods", "stages"}
"""Rooms whose files do not import each other; their `__init__` may import them all."""


def floors() -> list[list[str]]:
    """Read the map in the package's docstring: files and rooms (`room/`) from the ground up.

    On one floor, files may use each other, without circles.
    """
    plan = (astra_data.__doc__ or "").split("\n\n")[2]
    lines = re.sub(r"\(.*?\)|\n +", " ", plan).splitlines()
    return [names for _floor, *names in map(str.split, lines)]


def modules() -> dict[str, Path]:
    """Map each module's name below `astra_data` (empty for the package itself) to its file."""
    names = {path: path.relative_to(HOUSE).with_suffix("").as_posix() for path in HOUSE.rglob("*.py")}
    return {name.replace("/", ".").removesuffix("__init__").rstrip("."): path for path, name in names.items()}


def imports(path: Path, known: dict[str, Path]) -> Iterator[str]:
    """Yield the names of the house's modules that a file imports, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            targets = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for target in targets:
            package, _, name = target.partition(".")
            if package == "astra_data":
                yield name if name in known else name.rpartition(".")[0]


def test_the_map_names_every_file_and_room_once_and_no_others() -> None:
    drawn = [name for floor in floors() for name in floor]
    rooms = {f"{path.parent.name}/" for path in HOUSE.glob("*/*.py")}
    files = {path.stem for path in HOUSE.glob("*.py")} - {"__init__"}
    assert sorted(drawn) == sorted(files | rooms)


def test_imports_only_go_down() -> None:
    level = {name.rstrip("/"): number for number, floor in enumerate(floors()) for name in floor}
    known, faults = modules(), []
    for name, path in known.items():
        room = name.partition(".")[0]
        for target in imports(path, known):
            other = target.partition(".")[0]
            if name and level.get(other, 0) > level.get(room, 0):
                faults.append(f"{name} imports {target}, which is on a higher floor")
            is_room_file = "." in name and room in NO_NEIGHBOURS
            if is_room_file and level.get(other) == level.get(room):
                faults.append(f"{name} imports its neighbour {target}")
    assert not faults, "\n".join(faults)


def test_imports_form_no_circle() -> None:
    known = modules()
    graph = {name: set(imports(path, known)) - {name} for name, path in known.items()}
    TopologicalSorter(graph).prepare()


def test_no_folder_is_deeper_than_one() -> None:
    deep = [name for name in modules() if name.count(".") > 1]
    assert not deep


def test_no_file_is_longer_than_300_lines() -> None:
    lengths = {name: len(path.read_text().splitlines()) for name, path in modules().items()}
    assert not {name: length for name, length in lengths.items() if length > 300}
