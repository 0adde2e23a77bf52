"""Folders that stages make: not there until they are finished, and gone on with after an interruption."""

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from astra_data.core import durable
from astra_data.core.errors import BadInputError

CHECKPOINT = "checkpoint.pt"  # name, or the end of it, of the file that a training goes on from
_SETTINGS = "config.json"  # name of the file of the settings in a folder
MANIFEST = "manifest.json"
GROWING = ("trials.csv", "trials.json", "select.md")  # what trials in the target change later: no manifest has it


def refuse_finished(out: Path) -> None:
    """Refuse to make `out` once more, if it exists."""
    if out.exists():
        raise BadInputError(f"{out} is already finished: remove it to run the stage again")


@contextmanager
def finished_folder(
    out: Path, *, replace: bool = False, config: str | None = None, made_from: Mapping[str, str | None] | None = None
) -> Iterator[Path]:
    """Yield a working folder that becomes `out` when the block succeeds, without checkpoints of trainings.

    After a failure `.<name>.partial` stays if it holds more than the settings, and the next call yields it again: so
    trainings resume. With `replace` it begins empty; the older `out` is `.<name>.old` until then. A folder that was
    begun with another `config` is refused; `made_from` goes into the manifest.
    """
    partial, old = (out.parent / f".{out.name}.{state}" for state in ("partial", "old"))
    settings = partial / _SETTINGS

    def is_begun() -> bool:
        return any(path != settings for path in partial.iterdir())

    with durable.writing(out), ExitStack() as stack:
        made = durable.make_folder(partial)
        if not stack.enter_context(durable.held(partial)):
            raise BadInputError(f"{out} is being written right now: wait, or choose another folder")
        try:
            durable.sweep(out)
            if old.exists() and not out.exists():  # a kill came between the two renames below
                durable.move(old, out)
            if replace:
                for path in partial.iterdir():
                    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
                if old.exists():
                    durable.discard(old, out)
            else:
                refuse_finished(out)
            durable.clean(partial)
            if config is not None and not is_begun():
                durable.write_file(settings, config)
            elif config is not None and not (settings.is_file() and settings.read_text() == config):
                fault = "was started with other settings (see its config.json if it has one)"
                raise BadInputError(f"{partial} {fault}: remove it")
            yield partial
        except BaseException:
            with suppress(OSError):
                if not is_begun():
                    durable.discard(partial, out)
                    durable.remove_empty(made)
            raise
        for checkpoint in partial.glob(f"*{CHECKPOINT}"):
            checkpoint.unlink()
        if made_from is not None:
            write_manifest(partial, made_from)
        durable.clean(partial)
        durable.sync_tree(partial)
        if out.exists():
            durable.move(out, old)
        try:
            durable.move(partial, out)
        finally:
            with suppress(OSError):
                if out.exists():
                    durable.discard(old, out)
                else:
                    os.replace(old, out)


@dataclass(frozen=True)
class Manifest:
    """What an artifact consists of: path → size in bytes and sha256; what it was made from → digest."""

    files: Mapping[str, tuple[int, str]]
    made_from: Mapping[str, str]

    def faults(self, folder: Path, *, verify: bool) -> list[str]:
        """Return what `folder` lost: by the sizes of its files, with `verify` by their sha256 too."""
        found, faults = _files(folder), []
        for name, (size, digest) in self.files.items():
            if name not in found:
                faults.append(f"{name} is missing")
            elif (now := found[name].stat().st_size) != size:
                faults.append(f"{name} has {now:,} bytes, expected {size:,}")
            elif verify and durable.file_digest(found[name]) != digest:
                faults.append(f"{name} was altered")
        return faults


def check_intact(path: Path) -> None:
    """Refuse a file whose bytes are not those in the manifest beside it, if there is one."""
    manifest = read_manifest(path.parent)
    if manifest and path.name in manifest.files and manifest.files[path.name][1] != durable.file_digest(path):
        advice = f"restore it from a copy, or remove {path.parent} and run the recipe again"
        raise BadInputError(f"{path} was altered since it was made: {advice}")


def check_made_from(made: Path, read: Mapping[str, str | None]) -> None:
    """Refuse the artifact of a file `made` that was made from others than those that are `read` with it."""
    manifest = read_manifest(made.parent)
    made_from = manifest.made_from if manifest else {}
    if others := [name for name, digest in read.items() if digest and made_from.get(name, digest) != digest]:
        fault = f"was made from another {' and another '.join(others)} than the one used with it"
        advice = "restore the folders that belong together from a copy, or run the recipe again"
        raise BadInputError(f"{made.parent} {fault}: {advice}")


def write_manifest(folder: Path, made_from: Mapping[str, str | None]) -> None:
    """Write the manifest of all that is in `folder` now, leaving out of `made_from` what is None."""
    files = {
        name: {"bytes": path.stat().st_size, "sha256": durable.file_digest(path)}
        for name, path in _files(folder).items()
    }
    digests = {name: digest for name, digest in made_from.items() if digest}
    (folder / MANIFEST).write_text(json.dumps({"files": files, "made_from": digests}, indent=1))


def read_manifest(folder: Path) -> Manifest | None:
    """Return the manifest of the artifact in `folder`; None if it has none."""
    path = folder / MANIFEST
    if not path.exists():
        return None
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        files = {name: (int(file["bytes"]), str(file["sha256"])) for name, file in content["files"].items()}
        return Manifest(files, dict(content["made_from"]))
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise BadInputError(f"{MANIFEST} cannot be read in {folder} ({error})") from None


def _files(folder: Path) -> dict[str, Path]:
    """Return the files in `folder`, by their paths inside it, without its manifest and what is `GROWING`."""
    files = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*"))}
    return {name: path for name, path in files.items() if path.is_file() and name not in (MANIFEST, *GROWING)}
