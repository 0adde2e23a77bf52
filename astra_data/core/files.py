"""The files below a folder."""

from pathlib import Path


def files_below(folder: Path) -> list[Path]:
    """Return the files in `folder` and below, sorted, and those in folders elsewhere that links lead to.

    Each is there once: by its own path if it lies below `folder`, else by the first link. Links to a folder
    that holds `folder` are not followed.
    """
    root, seen, found, todo = folder.resolve(), set[Path](), list[Path](), [folder]
    while todo:
        links: list[Path] = []
        for here, folders, names in todo.pop(0).walk():
            if here.resolve() in seen:
                folders.clear()
                continue
            seen.add(here.resolve())
            paths = [here / name for name in names]
            links += [path for path in paths if path.is_dir()]
            found += [path for path in paths if path.is_file()]
        links = [link for link in links if not root.is_relative_to(link.resolve())]
        todo += sorted(links, key=lambda link: (link.name.startswith("."), link))
    return sorted(found)
