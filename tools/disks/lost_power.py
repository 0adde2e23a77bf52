"""What a power failure leaves on a disk, worked out from a journal of operations.

A file keeps the bytes of its last fsync; a folder keeps the entries of its last fsync. That is all that POSIX
promises. Real file systems often keep more, and not in order, so three outcomes are tried.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from disks.failing_disk import Kind, Operation

Outcome = Literal["all lost", "emptied", "zeroed"]
OUTCOMES: Mapping[Outcome, str] = {
    "all lost": "bytes and names without fsync are lost",
    "emptied": "names are kept in order, files without fsync are cut to what was synced",
    "zeroed": "names and sizes are kept, bytes without fsync are zeros",
}


@dataclass(eq=False)
class _File:
    live: bytearray = field(default_factory=bytearray)
    synced: bytes = b""


@dataclass(eq=False)
class _Link:
    target: str


@dataclass(eq=False)
class _Folder:
    live: "dict[str, _Node]" = field(default_factory=dict)
    synced: "dict[str, _Node]" = field(default_factory=dict)


_Node = _File | _Folder | _Link


class Memory:
    """The files below a folder, as a running system sees them and as its disk has them."""

    def __init__(self, root: Path) -> None:
        """Begin with what lies below `root` now, all of it on the disk."""
        self._root = str(root)
        self._top = _read(root)

    def replay(self, operations: Iterable[Operation]) -> None:
        """Do `operations`; but not failed ones, nor those outside of the root or on nameless files."""
        for operation in operations:
            if not operation.failed:
                self._do(operation)

    def write(self, root: Path, outcome: Outcome | None) -> None:
        """Write to the empty folder `root` what a power failure leaves, or with None, what there was."""
        _write(self._top, root, outcome)

    def synced_names(self) -> set[str]:
        """Return the names of files whose bytes and name are on the disk, whatever their folder."""
        return set(_synced(self._top))

    def _do(self, operation: Operation) -> None:
        folder, name = self._find(operation.path)
        if folder is None:
            return
        node = folder.live.get(name)
        match operation.kind:
            case Kind.OPEN:
                file = folder.live.setdefault(name, _File())
                if operation.offset and isinstance(file, _File):
                    file.live.clear()
            case Kind.WRITE if isinstance(node, _File):
                end = operation.offset + len(operation.data)
                node.live.extend(bytes(max(0, end - len(node.live))))
                node.live[operation.offset : end] = operation.data
            case Kind.TRUNCATE if isinstance(node, _File):
                del node.live[operation.offset :]
                node.live.extend(bytes(operation.offset - len(node.live)))
            case Kind.SYNC if isinstance(node, _File):
                node.synced = bytes(node.live)
            case Kind.SYNC if isinstance(node, _Folder):
                node.synced = dict(node.live)
            case Kind.RENAME | Kind.LINK if node:
                there, new = self._find(operation.other)
                if there is not None:
                    there.live[new] = node
                if operation.kind is Kind.RENAME:
                    del folder.live[name]
            case Kind.MKDIR:
                folder.live[name] = _Folder()
            case Kind.SYMLINK:
                folder.live[name] = _Link(operation.other)
            case Kind.UNLINK | Kind.RMDIR:
                folder.live.pop(name, None)

    def _find(self, path: str) -> tuple[_Folder | None, str]:
        """Return the folder that `path` lies in and its name there; the root is "" in one of its own."""
        if path == self._root:
            return _Folder({"": self._top}), ""
        if not path.startswith(f"{self._root}/"):
            return None, ""
        *parents, name = path[len(self._root) + 1 :].split("/")
        node: _Node | None = self._top
        for parent in parents:
            node = node.live.get(parent) if isinstance(node, _Folder) else None
        return (node, name) if isinstance(node, _Folder) else (None, "")


def _read(path: Path) -> _Folder:
    found: dict[str, _Node] = {}
    for child in path.iterdir():
        if child.is_symlink():
            found[child.name] = _Link(str(child.readlink()))
        elif child.is_dir():
            found[child.name] = _read(child)
        else:
            data = child.read_bytes()
            found[child.name] = _File(bytearray(data), data)
    return _Folder(found, dict(found))


def _write(folder: _Folder, path: Path, outcome: Outcome | None) -> None:
    for name, node in (folder.synced if outcome == "all lost" else folder.live).items():
        child = path / name
        match node:
            case _Folder():
                child.mkdir()
                _write(node, child, outcome)
            case _Link():
                child.symlink_to(node.target)
            case _File():
                child.write_bytes(_kept(node, outcome))


def _kept(file: _File, outcome: Outcome | None) -> bytes:
    if outcome is None:
        return bytes(file.live)
    if outcome == "zeroed":
        return file.synced[: len(file.live)].ljust(len(file.live), b"\0")
    return file.synced


def _synced(folder: _Folder) -> Iterable[str]:
    for name, node in folder.synced.items():
        if isinstance(node, _Folder):
            yield from _synced(node)
        elif isinstance(node, _File) and node.synced:
            yield name
