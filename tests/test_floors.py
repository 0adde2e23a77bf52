"""The house's plan, enforced: imports go down, rooms have no inner doors, files stay short."""

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

HOUSE = Path(__file__).parents[1] / "astra_data"

FLOORS = (
    (
        "errors",
        "columns",
        "seeding",
        "recipe",
        "batched",
        "progress",
        "simulator",
        "statistics",
        "rows",
        "lock",
        "cores",
    ),
    ("mazes", "free_space", "navigation", "physics", "ant", "abstraction", "checkpoint", "models"),
    ("dataset", "figures", "grounding_file", "target_encoder_file"),
    ("envs", "sims", "results"),
    (
        "tasks",
        "world",
        "gymnasium_faces",
        "method",
        "gap",
        "training_world",
        "policy_file",
        "deployment",
        "mismatch",
        "learners",
    ),
    ("methods",),
    ("stages",),
    ("schedule", "display", "plan", "run", "sweep", "cli"),
)
"""Files and rooms from the ground up; on one floor, files may use each other, without circles."""

NO_NEIGHBOURS = {"envs", "sims", "methods", "stages", "importers"}
"""Rooms whose files do not import each other; their `__init__` may import them all."""


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


def test_every_file_has_a_floor() -> None:
    placed = {name for floor in FLOORS for name in floor}
    strangers = {name.partition(".")[0] for name in modules()} - placed - {""}
    assert not strangers, f"give these a floor in FLOORS: {sorted(strangers)}"


def test_imports_only_go_down() -> None:
    level = {name: number for number, floor in enumerate(FLOORS) for name in floor}
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
