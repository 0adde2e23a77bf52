"""The user's code, as "cart.py:TASK" or "package.module:TASK": its objects, digests and faults."""

import ast
import hashlib
import importlib
import importlib.util
import json
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import entry_points
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from astra_data.core.durable import file_digest
from astra_data.core.errors import AstraDataError, BadInputError
from astra_data.core.lazy import Tensor, torch, without_gradients
from astra_data.worlds.objective import Objective
from astra_data.worlds.protocols import AbstractSimulator

_PREFIX = "astra_data_user_"  # of the names of modules that are files of the user's
_PACKAGE = Path(__file__).parents[1]
_NOT_READ = (".log", ".py", ".pyc")  # files that code names and does not read as data: it writes or imports them
# So that `ast.dump` writes the same in each version of Python, for digests.
_WHOLE: dict[str, bool] = {"show_empty": True} if sys.version_info >= (3, 13) else {}
_INSTALLED = ("site-packages", "dist-packages")  # in which what lies side by side need not belong together


def is_user_code(name: str) -> bool:
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


def offered(group: str) -> dict[str, str]:
    """Return what installed packages offer under a group of entry points: places of objects by name."""
    return {point.name: point.value for point in entry_points(group=group)}


def file_of(name: str) -> dict[str, str]:
    """Return the sha256 of the file that `name` begins with, as "file_sha256"; empty where it is none."""
    place = Path(name.rpartition(":")[0])
    return {"file_sha256": file_digest(place)} if place.suffix == ".py" and place.is_file() else {}


def user_object(name: str) -> Any:  # noqa: ANN401 - any object
    """Run the file or module that `name` begins with, and return the object that it ends with."""
    place, colon, attribute = name.rpartition(":")
    if not colon:
        raise BadInputError(f"{name}: expected a Python file or a module and a name in it, such as {name}:METHOD")
    if not place.endswith(".py") and not all(part.isidentifier() for part in place.split(".")):
        raise BadInputError(f"{place}: expected a Python file, such as cart.py, or a module, package.module")
    with explained(f"importing {place}"):
        module = _of_file(Path(place)) if place.endswith(".py") else importlib.import_module(place)
    if not hasattr(module, attribute):
        raise BadInputError(f"{place} has no '{attribute}'; it has {', '.join(_public_names(module)) or 'nothing'}")
    return getattr(module, attribute)


def _of_file(path: Path) -> ModuleType:
    if not path.is_file():
        where = "" if path.is_absolute() else f" in {Path.cwd()}"
        raise BadInputError(f"{path} does not exist{where}: expected a Python file")
    name = f"{_PREFIX}{path.stem}_{hashlib.sha256(f'{path.resolve()}'.encode()).hexdigest()[:12]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look it up there
    try:
        with _among_neighbors(str(path.resolve().parent)):
            spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


@contextmanager
def _among_neighbors(folder: str) -> Iterator[None]:
    """Let a file import those in its `folder`, not files of the same names beside other files of the user's."""
    files = {name: os.path.realpath(getattr(one, "__file__", None) or "") for name, one in sys.modules.items()}
    others = {os.path.dirname(file) for name, file in files.items() if _PREFIX in name} - {folder}
    shadowing = [name for name, file in files.items() if _PREFIX not in name and os.path.dirname(file) in others]
    theirs = {name: sys.modules.pop(name) for name in shadowing}
    paths = [*sys.path]
    sys.path[:] = [*(path for path in paths if path not in others), folder]
    try:
        yield
    finally:
        added = [path for path in sys.path if path not in (*paths, folder)]
        sys.path[:] = [*added, *paths, *([] if folder in paths else [folder])]
        sys.modules.update(theirs)


def _public_names(module: ModuleType) -> list[str]:
    here = module.__name__
    return [
        name
        for name, value in vars(module).items()
        if not (name.startswith("_") or isinstance(value, ModuleType))
        and (not isinstance(value, type | FunctionType) or value.__module__ == here)
    ]


@contextmanager
def explained(what: str) -> Iterator[None]:
    """Turn an exception of the user's code into a BadInputError of one line that begins with `what`."""
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
    """Return the file and line of the user's code at which `error` was raised; nothing where the message has it."""
    if isinstance(error, SyntaxError):
        return ""
    if where := user_line(error):
        return f" ({where})"
    last = traceback.extract_tb(error.__traceback__)[-1]
    if last.filename.startswith("<frozen") or Path(last.filename).is_relative_to(_PACKAGE):
        return ""
    return f" ({Path(last.filename).name}, line {last.lineno})"


def user_line(error: BaseException) -> str:
    """Return the last file of the user's that an `error` went through, and the line; empty where none is known."""
    users = {module.__file__ for name, module in sys.modules.items() if name.startswith(_PREFIX)}
    frames = traceback.extract_tb(error.__traceback__)
    places = [f"{Path(one.filename).name}, line {one.lineno}" for one in frames if one.filename in users]
    return places[-1] if places else ""


def code_digest(name: str) -> str | None:
    """Return a digest of the code at `name`, what it imports beside it and data it names; None if it is not found."""
    place = name.rpartition(":")[0]
    file = Path(place)
    files, folder = ([file], file.parent) if file.suffix == ".py" else _installed(place)
    if not files or not files[0].is_file():
        return None
    digest = hashlib.sha256()
    for path, tree in _with_neighbors(files, folder):
        name = path.relative_to(folder).as_posix()
        digest.update(f"{name}\n{ast.dump(tree, **_WHOLE)}\n".encode())
        for file in _named_beside(path, tree):
            digest.update(f"{file.name}\n{file_digest(file)}\n".encode())
    return digest.hexdigest()


def _with_neighbors(files: list[Path], folder: Path) -> Iterator[tuple[Path, ast.Module]]:
    """Yield `files` and those in `folder` that they import, all of a package, each once with its content."""
    todo, seen = [*files], set[Path]()
    while todo:
        path = todo.pop()
        seen.add(path)
        try:
            tree = ast.parse(path.read_bytes())
        except SyntaxError as error:
            if path.parent == folder:
                raise BadInputError(f"{path}, line {error.lineno}: expected Python, got {error.msg}") from None
            # A package may hold what is never imported, such as a template.
            tree = ast.Module([ast.Expr(ast.Constant(path.read_bytes()))], [])
        yield path, tree
        beside = set[Path]()
        for module in _imported(tree) if folder.name not in _INSTALLED else ():
            file = folder / f"{module}.py"
            beside |= {file} if file.is_file() else {*(folder / module).rglob("*.py")}
        todo += sorted(beside - seen - set(todo))


def _installed(module: str) -> tuple[list[Path], Path]:
    """Return the files of the outermost package of a module, or its own, and their folder; none of this package."""
    top, spec = module.partition(".")[0], None
    with suppress(ImportError, ValueError):
        spec = importlib.util.find_spec(top) if top != _PACKAGE.name else None
    if spec is None:
        return [], Path()
    if spec.submodule_search_locations:
        folder = Path(spec.submodule_search_locations[0])
        return sorted(folder.rglob("*.py")), folder.parent
    return [Path(spec.origin or "")], Path(spec.origin or "").parent


def _named_beside(place: Path, tree: ast.Module) -> list[Path]:
    """Return the files in the folder of `place`, models and data, whose paths, or their parts, are texts in it."""
    texts = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    paths = [Path(text) for text in texts if isinstance(text, str) and Path(text).parts]
    paths = [path for path in paths if not path.is_absolute() and ".." not in path.parts]
    found, folders = set[Path](), [place.parent]
    for folder in folders:
        beside = [folder / path for path in paths]
        found |= {file for file in beside if file.suffix not in _NOT_READ and os.path.isfile(file)}
        folders += sorted({one for one in beside if os.path.isdir(one)} - {*folders})
    return sorted(found)


def _imported(tree: ast.Module) -> set[str]:
    nodes = [*ast.walk(tree)]
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    return {name.partition(".")[0] for name in names}


def parts_of(learned: object) -> tuple[Mapping[str, Tensor], dict[str, Any]]:
    """Return the tensors and the metadata (JSON values) that `to_file` of something learned returns."""
    what = f"{type(learned).__name__}.to_file"
    returned = answered(what, learned.to_file)  # type: ignore[attr-defined]
    if not isinstance(returned, tuple | list) or [isinstance(part, Mapping) for part in returned] != [True, True]:
        kind = type(returned).__name__
        raise BadInputError(f"{what}: expected a pair, a dict of tensors and one of JSON values, got a {kind}")
    tensors, metadata = returned
    faults = [f"the name {name!r}, expected a text" for name in (*tensors, *metadata) if not isinstance(name, str)]
    for name, value in tensors.items():
        if not isinstance(value, torch.Tensor):
            kind = type(value).__name__
            faults.append(f"{name!r} is a {kind}, expected a torch tensor, as torch.as_tensor(value) is")
    for name, value in metadata.items():
        try:
            json.dumps(value)
        except (TypeError, ValueError):
            kind = type(value).__name__
            faults.append(f"{name!r} is a {kind}, expected a JSON value, or it among the tensors")
    if faults:
        raise BadInputError(f"{what}: {'; '.join(faults)}")
    return tensors, metadata


def restored[Made](made: type[Made], tensors: dict[str, Tensor], metadata: Mapping[str, Any], *device: str) -> Made:
    """Return what `from_file` of the class `made` returns; one of the user's that fails is a BadInputError."""
    from_file: Callable[..., Made] = made.from_file  # type: ignore[attr-defined]
    if made.__module__.partition(".")[0] == _PACKAGE.name:
        return from_file(tensors, metadata, *device)
    given = f"given the tensors {', '.join(tensors)} and the values {', '.join(metadata) or 'of nothing'},"
    return answered(f"{made.__name__}.from_file, {given}", from_file, tensors, metadata, *device)


def answered[Answer](what: str, function: Callable[..., Answer], *given: object) -> Answer:
    """Return what a `function` of the user's returns; errors begin with `what`."""
    with explained(what):
        return function(*given)


def expect(
    what: str,
    found: object,
    shape: tuple[int, ...],
    dtype: "torch.dtype | None" = None,
    device: "torch.device | None" = None,
) -> Tensor:
    """Return `found`, a finite tensor of `shape`, where -1 stands for any length; refuse what is none."""
    found = expect_tensor(what, found)
    if len(shape) != found.dim() or any(size not in (-1, got) for size, got in zip(shape, found.shape, strict=True)):
        expected = str(shape).replace("-1", "any")
        raise BadInputError(f"{what}: expected shape {expected}, got {tuple(found.shape)}")
    if dtype is not None and found.dtype != dtype:
        raise BadInputError(f"{what}: expected {dtype}, got {found.dtype}")
    if device is not None and found.device != device:
        raise BadInputError(f"{what}: expected a tensor on {device}, where its inputs are, got {found.device}")
    if not found.isfinite().all():
        raise BadInputError(f"{what}: expected finite numbers, got {float(found[~found.isfinite()][0])}")
    return found


def expect_tensor(what: str, found: object) -> Tensor:
    """Return `found`, a tensor; refuse what is none."""
    if not isinstance(found, torch.Tensor):
        raise BadInputError(f"{what}: expected a torch tensor, got a {type(found).__name__}")
    return found


@without_gradients
def stepped(simulator: AbstractSimulator, command: Tensor, what: str) -> Tensor:
    """Return the states (B, X) that a step with `command` (B, A) leads to; errors begin with `what`."""
    return expect_tensor(what, answered(what, simulator.step, command))


def judged(objective: Objective, name: str, state: Tensor, goal: Tensor) -> Tensor:
    """Return which states (B, X) are "reached" or "missed", as `name` says, (B,) bool."""
    what = f"objective.{name}(state, goal)"
    found = answered(what, getattr(objective, name), state, goal)
    return expect(what, found, (len(state),), torch.bool, state.device)


@without_gradients
def paid(objective: Objective, before: Tensor, after: Tensor, goal: Tensor, failed: Tensor) -> Tensor:
    """Return the rewards (B,) of steps between states (B, X)."""
    what = "objective.reward(before, after, goal, failed)"
    found = answered(what, objective.reward, before, after, goal, failed)
    return expect(what, found, (len(after),), torch.float32, after.device)
