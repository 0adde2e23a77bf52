"""The names of a recording's files in reports and metadata, each of one file."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from astra_data.core.digest import file_digest
from astra_data.exchange.recording import Source, files_of, named


def named_apart(sources: Sequence[Source]) -> list[Source]:
    """Name sources that are called alike by more of their paths."""
    within = ["" if source.member is None else source.member.name for source in sources]
    names = _longer(
        [str(source) for source in sources], [s.path / w for s, w in zip(sources, within, strict=True)]
    )
    return [replace(source, name=name) for source, name in zip(sources, names, strict=True)]


def identities(sources: Sequence[Source]) -> list[dict[str, str]]:
    """Return name and sha256 of every file of the recordings."""
    files = files_of(sources)
    names = _longer([named(file, recording) for file, recording in files.items()], list(files))
    return [{"name": name, "sha256": file_digest(file)} for name, file in zip(names, files, strict=True)]


def _longer(names: Sequence[str], paths: Sequence[Path]) -> list[str]:
    """Return `names`, the ends of `paths`; those of several paths are longer ends, by which these differ."""
    places = [path.absolute() for path in paths]
    of_name: dict[str, set[Path]] = {}
    for name, place in zip(names, places, strict=True):
        of_name.setdefault(name, set()).add(place)
    longer = [
        "/".join(place.parts[-len(PurePosixPath(name).parts) - 1 :]) if len(of_name[name]) > 1 else name
        for name, place in zip(names, places, strict=True)
    ]
    return longer if longer == list(names) else _longer(longer, paths)
