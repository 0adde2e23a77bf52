"""The table of rooms in CONTRIBUTING.md, enforced; and: folders are two deep at most, files stay short."""

import ast
import re
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
HOUSE = ROOT / "astra_data"
ALIASES = {"envs"}
"""Modules outside of every room, kept for what others import by an old name."""

NO_NEIGHBORS = {"io.importers", "methods", "pipeline.stages"}
"""Rooms whose files do not import each other; their `__init__` and `registry` may import them all."""

FOUNDATIONS = {"methods.method"}
"""What the files of such a room stand on."""


def rooms() -> list[str]:
    """Read the rooms from the ground up."""
    return re.findall(r"^\| `(\w+)` \|", (ROOT / "CONTRIBUTING.md").read_text(), flags=re.MULTILINE)


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


def test_the_table_names_every_room_once_and_no_others() -> None:
    folders = {path.parent.name for path in HOUSE.glob("*/__init__.py")}
    assert sorted(rooms()) == sorted(folders)
    assert {path.stem for path in HOUSE.glob("*.py")} == {"__init__", "__main__", *ALIASES}


def test_imports_only_go_down() -> None:
    level = {name: number for number, name in enumerate(rooms())}
    known = modules()
    arrows = [(name, target) for name, path in known.items() for target in imports(path, known)]
    faults = []
    for name, target in arrows:
        room, other = name.partition(".")[0], target.partition(".")[0]
        if room in level and level.get(other, 0) > level[room]:
            faults.append(f"{name} imports {target}, which is on a higher floor")
    assert len(arrows) > 500
    assert not faults, "\n".join(faults)


def test_stages_methods_and_formats_do_not_import_their_neighbors() -> None:
    known = modules()
    faults = [
        f"{name} imports its neighbor {target}"
        for name, path in known.items()
        for target in set(imports(path, known)) - FOUNDATIONS
        if (room := name.rpartition(".")[0]) in NO_NEIGHBORS
        and target.rpartition(".")[0] == room
        and not name.endswith(".registry")
    ]
    assert not faults, "\n".join(faults)


def test_imports_form_no_circle() -> None:
    known = modules()
    graph = {name: set(imports(path, known)) - {name} for name, path in known.items()}
    TopologicalSorter(graph).prepare()


def test_no_folder_is_deeper_than_two() -> None:
    deep = [name for name in modules() if name.count(".") > 2]
    assert not deep


def test_no_file_is_longer_than_600_lines() -> None:
    lengths = {name: len(path.read_text().splitlines()) for name, path in modules().items()}
    assert not {name: length for name, length in lengths.items() if length > 600}
