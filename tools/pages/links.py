"""Which files of the repository pages link to."""

import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from pages.notebooks import notebook_text

_FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\]\((?!\w+:)([^)#\s]+)")


def links(text: str) -> Iterator[str]:
    """Yield the relative addresses that a page links to, without anchors."""
    for found in _LINK.finditer(_FENCED.sub("", text)):
        yield found[1]


def linked(root: Path, pages: Iterable[str]) -> list[str]:
    """Return `pages` and everything in the repository that they, and pages among that, link to.

    Args:
        root: of the repository.
        pages: paths from there, as are those that are returned. A folder stands for the files in it.
    """
    found: dict[str, None] = {}
    waiting = list(pages)
    while waiting:
        name = waiting.pop(0)
        path = root / name
        if name in found or name.startswith("..") or not path.exists():
            continue
        found[name] = None
        if path.is_dir():
            waiting += [f"{name}/{file.relative_to(path).as_posix()}" for file in files_of(path)]
        elif path.suffix in {".md", ".ipynb"}:
            text = path.read_text() if path.suffix == ".md" else notebook_text(path)
            waiting += [os.path.normpath(Path(name).parent / link) for link in links(text)]
    return list(found)


def files_of(folder: Path) -> list[Path]:
    """Return the texts in `folder` and below: no pictures, and no numbers of results."""
    return sorted(file for file in folder.rglob("*") if file.suffix in {".md", ".py", ".toml", ".csv"})
