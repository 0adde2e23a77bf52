"""Digests of the user's code: of a file and what is beside it, or of an installed package."""

import ast
import hashlib
import importlib.util
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib.machinery import PathFinder
from pathlib import Path

from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError

_NOT_READ = (".log", ".py", ".pyc")
"""Endings of files that code names and does not read as data: what it writes, and code, which it imports."""
_WHOLE: dict[str, bool] = {"show_empty": True} if sys.version_info >= (3, 13) else {}
"""What makes `ast.dump` write the same in each version of Python, for digests."""
_PACKAGE = Path(__file__).parents[1]
_INSTALLED = ("site-packages", "dist-packages")
"""Names of folders in which what lies side by side need not belong together."""


def code_digest(name: str) -> str | None:
    """Return a digest of the code that `name` begins with; None where it is this package's, or not found.

    Of a file, the files and packages beside it that it imports count too; of an installed module, all of its
    package. So do models and data beside these that they name, such as a robot.xml; what they find without
    its name, comments and layout do not.

    Raises:
        BadInputError: one of these files is no Python.
    """
    place = name.rpartition(":")[0]
    file = Path(place)
    files, folder = ([file], file.parent) if file.suffix == ".py" else _installed(place)
    if not files or not files[0].is_file():
        return None
    digest = hashlib.sha256()
    for path, tree in with_neighbors(files, folder):
        name = path.relative_to(folder).as_posix()
        digest.update(f"{name}\n{ast.dump(tree, **_WHOLE)}\n".encode())
        for file in _named_beside(path, tree):
            digest.update(f"{file.name}\n{file_digest(file)}\n".encode())
    return digest.hexdigest()


def with_neighbors(files: list[Path], folder: Path) -> Iterator[tuple[Path, ast.Module]]:
    """Yield `files` and those in `folder` that they import, all of a package, each once, and what is in it.

    Raises:
        BadInputError: one of those in `folder` is no Python.
    """
    todo, seen = [*files], set[Path]()
    while todo:
        path = todo.pop()
        seen.add(path)
        try:
            tree = ast.parse(path.read_bytes())
        except SyntaxError as error:
            if path.parent == folder:
                raise BadInputError(
                    f"{path}, line {error.lineno}: expected Python, got {error.msg}"
                ) from None
            # A package may hold what is never imported, such as a template.
            tree = ast.Module([ast.Expr(ast.Constant(path.read_bytes()))], [])
        yield path, tree
        beside = {file for module in _imported(tree) for file in _files_of(module, folder)}
        todo += sorted(beside - seen - set(todo))


def _installed(module: str) -> tuple[list[Path], Path]:
    """Return the files of the outermost package that a module is in, or its own file, and their folder.

    There are none of this package, and of what is not found. None is run.
    """
    parts, places = module.split("."), None
    for end in range(1, len(parts) + 1) if parts[0] != _PACKAGE.name else ():
        spec, name = None, ".".join(parts[:end])
        with suppress(ImportError, ValueError):
            spec = importlib.util.find_spec(name) if end == 1 else PathFinder.find_spec(name, places)
        if spec is None:
            break
        places = spec.submodule_search_locations
        if spec.origin and spec.origin.endswith(".py"):  # a folder of packages has none
            file = Path(spec.origin)
            if places:
                return sorted(file.parent.rglob("*.py")), file.parents[1]
            return [file], file.parent
    return [], Path()


def _named_beside(place: Path, tree: ast.Module) -> list[Path]:
    """Return the models and data in the folder of `place` whose paths within it are texts in it.

    Or parts of their paths are, as in `folder / "data" / "weights.npz"`.
    """
    texts = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    paths = sorted({Path(text) for text in texts if isinstance(text, str)})
    paths = [path for path in paths if path.parts and not path.is_absolute() and ".." not in path.parts]
    found, todo, seen = set[Path](), [place.parent], set[str]()
    while todo:
        folder = todo.pop()
        if (real := os.path.realpath(folder)) in seen or not os.access(folder, os.R_OK):
            continue
        seen.add(real)
        names = {*os.listdir(folder)}
        beside = [folder / path for path in paths if path.parts[0] in names]
        found |= {file for file in beside if file.suffix not in _NOT_READ and os.path.isfile(file)}
        todo += [one for one in beside if os.path.isdir(one)]
    return sorted(found)


def _files_of(module: str, folder: Path) -> list[Path]:
    """Return the file of a top module in `folder`, or all of its package there that is not installed."""
    if folder.name in _INSTALLED:
        return []
    file, package = folder / f"{module}.py", folder / module
    if file.is_file() or not package.is_dir():
        return [file] if file.is_file() else []
    spec = None
    with suppress(ImportError, ValueError):
        spec = importlib.util.find_spec(module)
    if spec is not None and spec.origin and not Path(spec.origin).is_relative_to(folder.resolve()):
        return []
    return sorted(package.rglob("*.py"))


def _imported(tree: ast.Module) -> set[str]:
    """Return the names of the top modules that a file imports."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.partition(".")[0])
    return names
