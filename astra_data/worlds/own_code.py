"""Objects from the user's code: "cart.py:TASK" in a file, "package.module:TASK" in an installed package."""

import hashlib
import importlib
import importlib.util
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import entry_points
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from astra_data.core.durable import file_digest
from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.worlds.code_digest import with_neighbors

_PREFIX = "astra_data_own_"
"""Of the names of modules that are files of the user's."""
_PACKAGE = Path(__file__).parents[1]


def is_own_code(name: str) -> bool:
    """Return whether `name` is of the form "file.py:OBJECT" or "package.module:OBJECT"."""
    module, colon, attribute = name.rpartition(":")
    return bool(colon and module and attribute.isidentifier())


def place_beside(name: str, folder: Path) -> str:
    """Return `name` with its file, if it is one, looked up in `folder`."""
    return str(folder / name) if ".py:" in name else name


def found_near(name: str, folder: Path) -> str:
    """Return `name` with its file, if it is one, looked up in `folder` and those above it, and else here."""
    place, folder = Path(name.rpartition(":")[0]), folder.resolve()
    if place.suffix != ".py":
        return name
    found = next((one for one in (folder, *folder.parents) if (one / place).is_file()), Path.cwd())
    return name if found == Path.cwd() else str(found / name)


def own_object(name: str) -> Any:  # noqa: ANN401 - any object
    """Run the file or module that `name` begins with, and return the object that it ends with.

    Raises:
        BadInputError: there is no such file, module or object, or running it fails.
    """
    place, _, attribute = name.rpartition(":")
    module = _of_file(Path(place)) if place.endswith(".py") else _of_package(place)
    if not hasattr(module, attribute):
        raise BadInputError(
            f"{place} has no '{attribute}'; it has {', '.join(_own_names(module)) or 'nothing'}"
        )
    return getattr(module, attribute)


def offered(group: str) -> dict[str, str]:
    """Return what installed packages offer under a group of entry points: the place of each, by name."""
    return {point.name: point.value for point in entry_points(group=group)}


def file_of(name: str) -> dict[str, str]:
    """Return the sha256 of the file that `name` begins with, as "file_sha256"; empty where it is none."""
    place = Path(name.rpartition(":")[0])
    return {"file_sha256": file_digest(place)} if place.suffix == ".py" and place.is_file() else {}


def _of_file(path: Path) -> ModuleType:
    if not path.is_file():
        where = "" if path.is_absolute() else f" in {Path.cwd()}"
        raise BadInputError(f"{path} does not exist{where}: expected a Python file")
    key = hashlib.sha256(f"{path.resolve()}".encode()).hexdigest()[:12]
    name = f"{_PREFIX}{path.stem}_{key}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look it up there
    try:
        with explained(f"importing {path}"), _among_neighbors(path.resolve()):
            spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


_APPENDED: set[str] = set()
"""Folders of files of the user's that stand at the end of Python's path."""


@contextmanager
def _among_neighbors(path: Path) -> Iterator[None]:
    """Let a file import those beside it, whatever files of their names other files of the user's imported.

    Installed packages come first. What the others imported is theirs again afterwards.
    """
    folder, loaded, places = path.parent, dict(sys.modules), [*sys.path]
    known = {_folder_of(module) for name, module in loaded.items() if name.startswith(_PREFIX)} - {folder}
    theirs = {}
    with suppress(BadInputError):  # what is no Python is told where it is run
        for file, _ in with_neighbors([path], path.parent):
            if file.stem in loaded and _folder_of(loaded[file.stem]) in known:
                theirs[file.stem] = sys.modules.pop(file.stem)
    ours = [len(places) - 1 - places[::-1].index(place) for place in _APPENDED if place in places]
    inserted = f"{folder}"
    sys.path.insert(min(ours, default=len(places)), inserted)
    try:
        yield
    finally:
        sys.modules.update(theirs)
        sys.path[:] = [place for place in sys.path if place is not inserted]
    if f"{folder}" not in sys.path:
        sys.path.append(f"{folder}")  # what is imported later, too, unless the file failed
        _APPENDED.add(f"{folder}")


def _folder_of(module: ModuleType) -> Path | None:
    file = getattr(module, "__file__", None)
    return Path(file).resolve().parent if file else None


def _own_names(module: ModuleType) -> list[str]:
    """Return the public names that a module defines itself."""
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and not isinstance(value, ModuleType)
        and type(value).__module__ not in ("__future__", "typing")
        and not (isinstance(value, type | FunctionType) and value.__module__ != module.__name__)
    ]


def _of_package(name: str) -> ModuleType:
    if not all(part.isidentifier() for part in name.split(".")):
        raise BadInputError(f"{name}: expected a Python file, such as cart.py, or a module, package.module")
    with explained(f"importing {name}"):
        return importlib.import_module(name)


@contextmanager
def explained(what: str) -> Iterator[None]:
    """Turn an exception of the user's code into an error of one line that begins with `what`.

    Raises:
        BadInputError: for any exception.
    """
    try:
        yield
    except AstraDataError:
        raise
    except SystemExit as error:
        raise BadInputError(
            f"{what} ends the program{_place(error)}: expected code that defines things and does not exit, "
            'such as a script behind `if __name__ == "__main__":`'
        ) from error
    except Exception as error:
        message = " ".join(filter(None, map(str.strip, str(error).splitlines())))
        raise BadInputError(f"{what} fails with {type(error).__name__}: {message}{_place(error)}") from error


def _place(error: BaseException) -> str:
    """Return the file and line of the user's code at which `error` was raised, or else where it was.

    Nothing is returned where that is this package or the import system, or where the message has it already.
    """
    if isinstance(error, SyntaxError):
        return ""
    own = {module.__file__ for name, module in sys.modules.items() if name.startswith(_PREFIX)}
    frames = traceback.extract_tb(error.__traceback__)
    last = next((frame for frame in reversed(frames) if frame.filename in own), frames[-1])
    if last.filename.startswith("<frozen") or Path(last.filename).is_relative_to(_PACKAGE):
        return ""
    return f" ({Path(last.filename).name}, line {last.lineno})"
