"""Folders that stages make: not there until they are finished, and gone on with after an interruption."""

import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from astra_data.core.disk import writing
from astra_data.core.durable import (
    clean,
    discard,
    make_folder,
    move,
    remove_empty,
    sweep,
    sync_tree,
    write_file,
)
from astra_data.core.errors import BadInputError
from astra_data.core.lock import held
from astra_data.core.manifest import write_manifest

CHECKPOINT = "checkpoint.safetensors"
"""Name, or the end of it, of the file that a training goes on from."""
_SETTINGS = "config.json"
"""Name of the file of the settings in a folder."""


def refuse_finished(out: Path) -> None:
    """Refuse to make `out` once more.

    Raises:
        BadInputError: it exists.
    """
    if out.exists():
        raise BadInputError(f"{out} is already finished: remove it to run the stage again")


@contextmanager
def finished_folder(
    out: Path,
    *,
    replace: bool = False,
    config: str | None = None,
    made_from: Mapping[str, str | None] | None = None,
) -> Iterator[Path]:
    """Yield a working folder that becomes `out` when the block succeeds, without checkpoints of trainings.

    After a failure the working folder, `.<name>.partial` beside `out`, stays if it holds more than the
    settings: the next call yields it again with its contents, so that training can resume from its last
    checkpoint. With `replace` it begins empty instead; the older `out` is kept as `.<name>.old` until the new
    one is in its place.

    Args:
        out: the finished folder.
        replace: replace an existing `out`.
        config: the settings as JSON, written to `config.json`; a working folder with others is refused.
        made_from: for its manifest, see `write_manifest`; without it, none is written.

    Raises:
        BadInputError: `out` exists and `replace` is not set, was begun with other settings, or is being made
            by another process.
        DiskError: it cannot be written.
    """
    partial, old = (out.parent / f".{out.name}.{state}" for state in ("partial", "old"))
    with writing(out), ExitStack() as stack:
        made = make_folder(partial)
        if not stack.enter_context(held(partial)):
            raise BadInputError(f"{out} is being written right now: wait, or choose another folder")
        try:
            sweep(out)
            if old.exists() and not out.exists():  # a kill came between the two renames below
                move(old, out)
            if replace:
                _empty(partial)
                if old.exists():
                    discard(old, out)
            else:
                refuse_finished(out)
            clean(partial)
            if config is not None:
                _begin(partial, config)
            yield partial
        except BaseException:
            with suppress(OSError):
                if {path.name for path in partial.iterdir()} <= {_SETTINGS}:
                    discard(partial, out)
                    remove_empty(made)
            raise
        for checkpoint in partial.glob(f"*{CHECKPOINT}"):
            checkpoint.unlink()
        if made_from is not None:
            write_manifest(partial, made_from)
        clean(partial)
        sync_tree(partial)
        _put(partial, out, old)


def _empty(folder: Path) -> None:
    """Remove all that `folder` holds."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _put(partial: Path, out: Path, old: Path) -> None:
    """Rename `partial` to `out`; an older `out` is `old` in between, and comes back after an error."""
    if out.exists():
        move(out, old)
    try:
        move(partial, out)
    finally:
        with suppress(OSError):
            if out.exists():
                discard(old, out)
            else:
                os.replace(old, out)


def _begin(partial: Path, config: str) -> None:
    """Write the settings to `partial`, unless it was begun with them."""
    settings = partial / _SETTINGS
    if {path.name for path in partial.iterdir()} <= {_SETTINGS}:
        write_file(settings, config)
    elif not (settings.is_file() and settings.read_text() == config):
        raise BadInputError(
            f"{partial} was started with other settings (see its config.json if it has one): remove it"
        )
