"""The files below a folder."""

from pathlib import Path


def files_below(folder: Path) -> list[Path]:
    """Return the files in `folder` and below, sorted; links to folders are followed, each folder once."""
    seen, found = set[Path](), list[Path]()
    for here, folders, names in folder.walk(follow_symlinks=True):
        if here.resolve() in seen:
            folders.clear()
            continue
        seen.add(here.resolve())
        found += [here / name for name in names if (here / name).is_file()]
    return sorted(found)
